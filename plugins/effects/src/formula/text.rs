//! Reading a formula: text to tree, with the place of whatever is wrong.
//!
//! ```text
//! sum     = product { ("+" | "-") product }
//! product = signed { ("*" | "/") signed }
//! signed  = "-" signed | "+" signed | power
//! power   = atom [ "^" signed ]                  so that -x^2 is -(x^2), and 2^3^2 is 2^(3^2)
//! atom    = number | name | function "(" sum { "," sum } ")" | "(" sum ")"
//! ```

use std::fmt;

/// Longest formula, bytes: one that is longer is no formula.
const LONGEST: usize = 4096;
/// Deepest nesting of brackets and signs.
const DEEPEST: usize = 64;

/// What is wrong with a formula, and where.
#[derive(Clone, Debug, PartialEq)]
pub struct TextError {
    /// What is wrong.
    pub what: String,
    /// Byte of the text at which it is.
    pub at: usize,
}

impl TextError {
    pub(super) fn new(what: impl Into<String>, at: usize) -> Self {
        Self { what: what.into(), at }
    }

    /// The sentence, the formula below it, and a caret below the place.
    #[must_use]
    pub fn marked(&self, text: &str) -> String {
        let before = text.get(..self.at).map_or(0, |before| before.chars().count());
        let line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        format!("column {}: {}\n  {line}\n  {}^", before + 1, self.what, " ".repeat(before))
    }
}

/// Operators between two operands.
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

/// A formula.
#[derive(Clone, Debug, PartialEq)]
pub enum Tree {
    /// A number, not negative.
    Number(f64),
    /// A name, and the byte of the text at which it stands.
    Name(String, usize),
    /// The opposite.
    Minus(Box<Tree>),
    /// Two operands.
    Both(Operator, Box<Tree>, Box<Tree>),
    /// A function of arguments, and the byte at which its name stands.
    Call(String, Vec<Tree>, usize),
}

/// Fully bracketed, so that reading it again gives the same tree, places apart.
impl fmt::Display for Tree {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number:?}"),
            Self::Name(name, _) => f.write_str(name),
            Self::Minus(inner) => write!(f, "(-{inner})"),
            Self::Both(operator, a, b) => write!(f, "({a}{}{b})", operator.sign()),
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

/// Reads a formula.
///
/// # Errors
/// [`TextError`] says what is wrong and where.
pub fn read(text: &str) -> Result<Tree, TextError> {
    if text.len() > LONGEST {
        return Err(TextError::new(format!("the formula is longer than {LONGEST} bytes"), LONGEST));
    }
    let mut reader = Reader { text, at: 0, depth: 0 };
    let tree = reader.sum()?;
    match reader.peek() {
        None => Ok(tree),
        Some(')') => Err(TextError::new("this bracket closes nothing", reader.at)),
        Some(_) => Err(TextError::new("an operator or the end is missing here", reader.at)),
    }
}

struct Reader<'a> {
    text: &'a str,
    at: usize,
    depth: usize,
}

impl Reader<'_> {
    /// The next character that is no space.
    fn peek(&mut self) -> Option<char> {
        let rest = self.text.get(self.at..)?;
        let trimmed = rest.trim_start();
        self.at += rest.len() - trimmed.len();
        trimmed.chars().next()
    }

    /// Takes one of these characters if it comes next.
    fn take(&mut self, any: &str) -> Option<char> {
        let next = self.peek().filter(|c| any.contains(*c))?;
        self.at += next.len_utf8();
        Some(next)
    }

    /// Takes characters as long as they are of a kind.
    fn run(&mut self, mut of_kind: impl FnMut(char) -> bool) -> String {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let taken: String = rest.chars().take_while(|c| of_kind(*c)).collect();
        self.at += taken.len();
        taken
    }

    fn deeper<T>(&mut self, inner: impl FnOnce(&mut Self) -> Result<T, TextError>) -> Result<T, TextError> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return Err(TextError::new(format!("nested more than {DEEPEST} deep"), self.at));
        }
        let made = inner(self);
        self.depth -= 1;
        made
    }

    fn chain(&mut self, signs: &str, next: impl Fn(&mut Self) -> Result<Tree, TextError>) -> Result<Tree, TextError> {
        let mut tree = next(self)?;
        let mut length = 0;
        while let Some(sign) = self.take(signs) {
            // A long chain leans to the left, as deep as it is long.
            length += 1;
            if length > DEEPEST {
                return Err(TextError::new(
                    format!("more than {DEEPEST} operands in a row; bracket some of them"),
                    self.at,
                ));
            }
            let operator =
                Operator::ALL.iter().find(|(_, s)| *s == sign).map_or(Operator::Add, |(operator, _)| *operator);
            tree = Tree::Both(operator, Box::new(tree), Box::new(next(self)?));
        }
        Ok(tree)
    }

    fn sum(&mut self) -> Result<Tree, TextError> {
        self.deeper(|r| r.chain("+-", |r| r.chain("*/", Self::signed)))
    }

    fn signed(&mut self) -> Result<Tree, TextError> {
        match self.take("+-") {
            Some('-') => Ok(Tree::Minus(Box::new(self.deeper(Self::signed)?))),
            Some(_) => self.deeper(Self::signed),
            None => self.power(),
        }
    }

    fn power(&mut self) -> Result<Tree, TextError> {
        let base = self.atom()?;
        if self.take("^").is_none() {
            return Ok(base);
        }
        let exponent = self.deeper(Self::signed)?;
        Ok(Tree::Both(Operator::Power, Box::new(base), Box::new(exponent)))
    }

    fn atom(&mut self) -> Result<Tree, TextError> {
        let next = self.peek();
        let at = self.at;
        match next {
            None => Err(TextError::new("the formula ends where a number, a name or a bracket should come", at)),
            Some('(') => {
                self.take("(");
                let inner = self.sum()?;
                self.close(at)?;
                Ok(inner)
            }
            Some(c) if c.is_ascii_digit() || c == '.' => self.number(at),
            Some(c) if c.is_ascii_alphabetic() || c == '_' => {
                let name = self.run(|c| c.is_ascii_alphanumeric() || c == '_' || c == '.');
                if self.take("(").is_none() {
                    return Ok(Tree::Name(name, at));
                }
                let mut arguments = vec![self.sum()?];
                while self.take(",").is_some() {
                    arguments.push(self.sum()?);
                }
                self.close(at)?;
                Ok(Tree::Call(name, arguments, at))
            }
            Some(c) => Err(TextError::new(format!("`{}` cannot stand here", c.escape_debug()), at)),
        }
    }

    fn close(&mut self, opened: usize) -> Result<(), TextError> {
        match self.peek() {
            _ if self.take(")").is_some() => Ok(()),
            None => Err(TextError::new("what opens here is never closed", opened)),
            Some(_) => Err(TextError::new("an operator or a closing bracket is missing here", self.at)),
        }
    }

    fn number(&mut self, at: usize) -> Result<Tree, TextError> {
        let mut last = ' ';
        // A sign belongs to the number only behind an e.
        let text = self.run(|c| {
            let part =
                c.is_ascii_alphanumeric() || c == '.' || ((c == '+' || c == '-') && (last == 'e' || last == 'E'));
            last = c;
            part
        });
        let number = text.parse::<f64>().ok().filter(|x| x.is_finite());
        number.map(Tree::Number).ok_or_else(|| TextError::new(format!("`{text}` is no number"), at))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    fn printed(text: &str) -> String {
        read(text).map_or_else(|e| panic!("{text}: {}", e.marked(text)), |tree| tree.to_string())
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
    fn what_is_wrong_is_marked() {
        for (text, at, part) in [
            ("a + * b", 4, "`*` cannot stand here"),
            ("sin(a", 0, "never closed"),
            ("(a + b c)", 7, "closing bracket"),
            ("a b", 2, "operator"),
            ("a)", 1, "closes nothing"),
            ("1.2.3", 0, "no number"),
            ("", 0, "ends where"),
            ("3 + ", 4, "ends where"),
            ("a × b", 2, "operator"),
            ("hk.a $ 2", 5, "operator"),
        ] {
            let error = read(text).expect_err(text);
            assert!(error.at == at && error.what.contains(part), "{text}: {error:?}");
        }
        let error = read("a + ÄÄ").expect_err("no letters of ours");
        assert_eq!(error.marked("a + ÄÄ"), "column 5: `Ä` cannot stand here\n  a + ÄÄ\n      ^");
    }

    #[test]
    fn what_never_ends_is_refused() {
        for text in ["(".repeat(4000), "-".repeat(4000), "2^".repeat(2000), "1+".repeat(2000), "f(".repeat(2000)] {
            assert!(read(&text).is_err());
        }
        assert!(read(&"1".repeat(5000)).is_err());
    }

    /// Any tree of a few leaves.
    pub(in super::super) fn trees(names: &'static [&'static str]) -> impl Strategy<Value = Tree> {
        let leaf = prop_oneof![
            (0.0..1e3_f64).prop_map(Tree::Number),
            prop::sample::select(names).prop_map(|name| Tree::Name(name.to_owned(), 0)),
        ];
        leaf.prop_recursive(4, 24, 2, |inner| {
            let operator = prop::sample::select(&Operator::ALL[..]);
            prop_oneof![
                inner.clone().prop_map(|tree| Tree::Minus(Box::new(tree))),
                (operator, inner.clone(), inner.clone()).prop_map(|((operator, _), a, b)| Tree::Both(
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

    fn without_places(tree: Tree) -> Tree {
        match tree {
            Tree::Name(name, _) => Tree::Name(name, 0),
            Tree::Minus(inner) => Tree::Minus(Box::new(without_places(*inner))),
            Tree::Both(o, a, b) => Tree::Both(o, Box::new(without_places(*a)), Box::new(without_places(*b))),
            Tree::Call(name, all, _) => Tree::Call(name, all.into_iter().map(without_places).collect(), 0),
            Tree::Number(_) => tree,
        }
    }

    proptest! {
        #[test]
        fn what_is_printed_reads_back(tree in trees(&["hk.a", "alpha.x", "t_s"])) {
            let again = read(&tree.to_string());
            prop_assert_eq!(again.map(without_places), Ok(tree));
        }

        #[test]
        fn no_text_makes_it_panic(text in "\\PC{0,200}") {
            if let Err(error) = read(&text) {
                let _ = error.marked(&text);
            }
        }

        #[test]
        fn nor_does_one_of_the_right_letters(text in "[-+*/^().,e0-9a-z _]{0,120}") {
            if let Err(error) = read(&text) {
                let _ = error.marked(&text);
            }
        }
    }
}
