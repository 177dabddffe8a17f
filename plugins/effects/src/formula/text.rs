//! Parser of formulas, with the position of any error.
//!
//! ```text
//! sum     = product { ("+" | "-") product }
//! product = signed { ("*" | "/") signed }
//! signed  = "-" signed | "+" signed | power
//! power   = atom [ "^" signed ]                  so that -x^2 is -(x^2), and 2^3^2 is 2^(3^2)
//! atom    = number | name | function "(" sum { "," sum } ")" | "(" sum ")"
//! ```

use std::fmt;

/// Maximum length of a formula, bytes.
const MAX_BYTES: usize = 4096;
/// Maximum nesting of brackets and signs, and number of operands in a row.
const MAX_DEPTH: usize = 64;

/// An error in a formula, with its position.
#[derive(Clone, Debug, PartialEq)]
pub struct TextError {
    /// Message.
    pub what: String,
    /// Byte offset in the text.
    pub at: usize,
}

impl TextError {
    pub(super) fn new(what: impl Into<String>, at: usize) -> Self {
        Self { what: what.into(), at }
    }

    /// The message, the formula below it, and a caret below the position.
    pub fn marked(&self, text: &str) -> String {
        let before = text.get(..self.at).map_or(0, |before| before.chars().count());
        let line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        format!("column {}: {}\n  {line}\n  {}^", before + 1, self.what, " ".repeat(before))
    }
}

/// Binary operators.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Operator {
    /// `+`
    Add,
    /// `-`
    Subtract,
    /// `*`
    Multiply,
    /// `/`
    Divide,
    /// `^`
    Power,
}

impl Operator {
    pub(super) const ALL: [(Self, char); 5] =
        [(Self::Add, '+'), (Self::Subtract, '-'), (Self::Multiply, '*'), (Self::Divide, '/'), (Self::Power, '^')];

    pub(super) fn sign(self) -> char {
        Self::ALL.iter().find(|(operator, _)| *operator == self).map_or('?', |(_, sign)| *sign)
    }
}

/// Syntax tree of a formula.
#[derive(Clone, Debug, PartialEq)]
pub enum Tree {
    /// A nonnegative number.
    Number(f64),
    /// A name, with its byte offset.
    Name(String, usize),
    /// Negation.
    Negate(Box<Tree>),
    /// Operator with two operands.
    Binary(Operator, Box<Tree>, Box<Tree>),
    /// Function call, with the byte offset of its name.
    Call(String, Vec<Tree>, usize),
}

/// Fully bracketed: parsing it again gives the same tree, offsets apart.
impl fmt::Display for Tree {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number:?}"),
            Self::Name(name, _) => f.write_str(name),
            Self::Negate(inner) => write!(f, "(-{inner})"),
            Self::Binary(operator, a, b) => write!(f, "({a}{}{b})", operator.sign()),
            Self::Call(function, arguments, _) => {
                write!(f, "{function}(")?;
                for (i, argument) in arguments.iter().enumerate() {
                    write!(f, "{}{argument}", if i > 0 { "," } else { "" })?;
                }
                f.write_str(")")
            }
        }
    }
}

/// Parses a formula.
///
/// # Errors
/// [`TextError`]: message and position.
pub fn parse(text: &str) -> Result<Tree, TextError> {
    if text.len() > MAX_BYTES {
        return Err(TextError::new(format!("the formula is longer than {MAX_BYTES} bytes"), MAX_BYTES));
    }
    let mut parser = Parser { text, at: 0, depth: 0 };
    let tree = parser.sum()?;
    match parser.peek() {
        None => Ok(tree),
        Some(')') => Err(TextError::new("this bracket was not opened", parser.at)),
        Some(_) => Err(TextError::new("expected an operator or the end", parser.at)),
    }
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    depth: usize,
}

impl Parser<'_> {
    /// Next character that is not white space.
    fn peek(&mut self) -> Option<char> {
        let rest = self.text.get(self.at..)?;
        let trimmed = rest.trim_start();
        self.at += rest.len() - trimmed.len();
        trimmed.chars().next()
    }

    /// Consumes the next character if it is one of these.
    fn take_any(&mut self, any: &str) -> Option<char> {
        let next = self.peek().filter(|c| any.contains(*c))?;
        self.at += next.len_utf8();
        Some(next)
    }

    /// Consumes characters while `of_kind` holds.
    fn take_while(&mut self, mut of_kind: impl FnMut(char) -> bool) -> String {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let taken: String = rest.chars().take_while(|c| of_kind(*c)).collect();
        self.at += taken.len();
        taken
    }

    fn nested<T>(&mut self, inner: impl FnOnce(&mut Self) -> Result<T, TextError>) -> Result<T, TextError> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(TextError::new(format!("nested more than {MAX_DEPTH} deep"), self.at));
        }
        let made = inner(self);
        self.depth -= 1;
        made
    }

    fn chain(&mut self, signs: &str, next: impl Fn(&mut Self) -> Result<Tree, TextError>) -> Result<Tree, TextError> {
        let mut tree = next(self)?;
        let mut length = 0;
        while let Some(sign) = self.take_any(signs) {
            // The tree of a chain is as deep as the chain is long.
            length += 1;
            if length > MAX_DEPTH {
                return Err(TextError::new(
                    format!("more than {MAX_DEPTH} operands in a row; bracket some of them"),
                    self.at,
                ));
            }
            let operator =
                Operator::ALL.iter().find(|(_, s)| *s == sign).map_or(Operator::Add, |(operator, _)| *operator);
            tree = Tree::Binary(operator, Box::new(tree), Box::new(next(self)?));
        }
        Ok(tree)
    }

    fn sum(&mut self) -> Result<Tree, TextError> {
        self.nested(|r| r.chain("+-", |r| r.chain("*/", Self::signed)))
    }

    fn signed(&mut self) -> Result<Tree, TextError> {
        match self.take_any("+-") {
            Some('-') => Ok(Tree::Negate(Box::new(self.nested(Self::signed)?))),
            Some(_) => self.nested(Self::signed),
            None => self.power(),
        }
    }

    fn power(&mut self) -> Result<Tree, TextError> {
        let base = self.atom()?;
        if self.take_any("^").is_none() {
            return Ok(base);
        }
        let exponent = self.nested(Self::signed)?;
        Ok(Tree::Binary(Operator::Power, Box::new(base), Box::new(exponent)))
    }

    fn atom(&mut self) -> Result<Tree, TextError> {
        let next = self.peek();
        let at = self.at;
        match next {
            None => Err(TextError::new("unexpected end of the formula: expected a number, a name or a bracket", at)),
            Some('(') => {
                self.take_any("(");
                let inner = self.sum()?;
                self.close(at)?;
                Ok(inner)
            }
            Some(c) if c.is_ascii_digit() || c == '.' => self.number(at),
            Some(c) if c.is_ascii_alphabetic() || c == '_' => {
                let name = self.take_while(|c| c.is_ascii_alphanumeric() || c == '_' || c == '.');
                if self.take_any("(").is_none() {
                    return Ok(Tree::Name(name, at));
                }
                let mut arguments = vec![self.sum()?];
                while self.take_any(",").is_some() {
                    arguments.push(self.sum()?);
                }
                self.close(at)?;
                Ok(Tree::Call(name, arguments, at))
            }
            Some(c) => Err(TextError::new(format!("`{}` is unexpected here", c.escape_debug()), at)),
        }
    }

    fn close(&mut self, opened: usize) -> Result<(), TextError> {
        match self.peek() {
            _ if self.take_any(")").is_some() => Ok(()),
            None => Err(TextError::new("this bracket is not closed", opened)),
            Some(_) => Err(TextError::new("expected an operator or a closing bracket", self.at)),
        }
    }

    fn number(&mut self, at: usize) -> Result<Tree, TextError> {
        let mut last = ' ';
        // A sign is part of a number only in an exponent.
        let text = self.take_while(|c| {
            let part =
                c.is_ascii_alphanumeric() || c == '.' || ((c == '+' || c == '-') && (last == 'e' || last == 'E'));
            last = c;
            part
        });
        let number = text.parse::<f64>().ok().filter(|x| x.is_finite());
        number.map(Tree::Number).ok_or_else(|| TextError::new(format!("`{text}` is not a number"), at))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    fn printed(text: &str) -> String {
        parse(text).map_or_else(|e| panic!("{text}: {}", e.marked(text)), |tree| tree.to_string())
    }

    #[test]
    fn operators_bind_as_in_mathematics() {
        for (text, tree) in [
            ("1+2*x", "(1.0+(2.0*x))"),
            ("1-2-3", "((1.0-2.0)-3.0)"),
            ("a/b*c", "((a/b)*c)"),
            ("-x^2", "(-(x^2.0))"),
            ("2^-x", "(2.0^(-x))"),
            ("2^3^2", "(2.0^(3.0^2.0))"),
            ("a*-b", "(a*(-b))"),
            ("--x", "(-(-x))"),
            ("1e-9*lag( hk.a , 4.5E2 )", "(1e-9*lag(hk.a,450.0))"),
            ("(a+b)*c", "((a+b)*c)"),
            (".5", "0.5"),
        ] {
            assert_eq!(printed(text), tree, "{text}");
        }
    }

    #[test]
    fn errors_are_located() {
        for (text, at, part) in [
            ("a + * b", 4, "`*` is unexpected here"),
            ("sin(a", 0, "not closed"),
            ("(a + b c)", 7, "closing bracket"),
            ("a b", 2, "operator"),
            ("a)", 1, "not opened"),
            ("1.2.3", 0, "not a number"),
            ("", 0, "unexpected end"),
            ("3 + ", 4, "unexpected end"),
            ("a × b", 2, "operator"),
            ("hk.a $ 2", 5, "operator"),
        ] {
            let error = parse(text).expect_err(text);
            assert!(error.at == at && error.what.contains(part), "{text}: {error:?}");
        }
        let error = parse("a + ÄÄ").expect_err("no letters of ours");
        assert_eq!(error.marked("a + ÄÄ"), "column 5: `Ä` is unexpected here\n  a + ÄÄ\n      ^");
    }

    #[test]
    fn long_and_deep_formulas_are_refused() {
        for text in ["(".repeat(4000), "-".repeat(4000), "2^".repeat(2000), "1+".repeat(2000), "f(".repeat(2000)] {
            assert!(parse(&text).is_err());
        }
        assert!(parse(&"1".repeat(5000)).is_err());
    }

    /// Random trees of a few leaves.
    pub(in super::super) fn trees(names: &'static [&'static str]) -> impl Strategy<Value = Tree> {
        let leaf = prop_oneof![
            (0.0..1e3_f64).prop_map(Tree::Number),
            prop::sample::select(names).prop_map(|name| Tree::Name(name.to_owned(), 0)),
        ];
        leaf.prop_recursive(4, 24, 2, |inner| {
            let operator = prop::sample::select(&Operator::ALL[..]);
            prop_oneof![
                inner.clone().prop_map(|tree| Tree::Negate(Box::new(tree))),
                (operator, inner.clone(), inner.clone()).prop_map(|((operator, _), a, b)| Tree::Binary(
                    operator,
                    Box::new(a),
                    Box::new(b)
                )),
                (prop::sample::select(&["sin", "abs", "exp"][..]), inner).prop_map(|(name, tree)| Tree::Call(
                    name.to_owned(),
                    vec![tree],
                    0
                )),
            ]
        })
    }

    fn without_offsets(tree: Tree) -> Tree {
        match tree {
            Tree::Name(name, _) => Tree::Name(name, 0),
            Tree::Negate(inner) => Tree::Negate(Box::new(without_offsets(*inner))),
            Tree::Binary(o, a, b) => Tree::Binary(o, Box::new(without_offsets(*a)), Box::new(without_offsets(*b))),
            Tree::Call(name, all, _) => Tree::Call(name, all.into_iter().map(without_offsets).collect(), 0),
            Tree::Number(_) => tree,
        }
    }

    proptest! {
        #[test]
        fn printed_trees_parse_back(tree in trees(&["hk.a", "alpha.x", "t_s"])) {
            let again = parse(&tree.to_string());
            prop_assert_eq!(again.map(without_offsets), Ok(tree));
        }

        #[test]
        fn no_text_makes_the_parser_panic(text in "\\PC{0,200}") {
            if let Err(error) = parse(&text) {
                let _ = error.marked(&text);
            }
        }

        #[test]
        fn no_text_of_formula_characters_makes_the_parser_panic(text in "[-+*/^().,e0-9a-z _]{0,120}") {
            if let Err(error) = parse(&text) {
                let _ = error.marked(&text);
            }
        }
    }
}
