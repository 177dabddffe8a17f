//! Formulas compiled to a list of steps, each of which computes one column per batch.
//!
//! `exmex` evaluates arithmetic over [`Values`], whole chunks of rows, so interpreting an expression is paid once per
//! [`CHUNK_ROWS`] rows. Functions with state are steps of their own: `lag(x, 60) * y` is one step for the lag and one
//! for the product.

use dragfree_sdk::state::{State, StateError};
use exmex::{BinOp, ExError, ExResult, Express, FlatEx, MakeOperators, Operator as ExOperator};
use std::f64::consts::{PI, TAU};
use std::str::FromStr;

use super::text::{TextError, Tree};
use crate::lag::Lags;

/// Rows evaluated at once; a chunk fits in the L1 cache.
pub(super) const CHUNK_ROWS: usize = 1024;

/// A constant, or one number per row.
#[derive(Clone, Debug)]
pub(super) enum Values {
    /// Equal in all rows.
    Constant(f64),
    /// One number per row.
    PerRow(Vec<f64>),
}

impl Default for Values {
    fn default() -> Self {
        Self::Constant(f64::NAN)
    }
}

/// Required by `exmex` for literals, which formulas pass as variables.
impl FromStr for Values {
    type Err = std::num::ParseFloatError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        text.parse().map(Self::Constant)
    }
}

impl Values {
    fn map(self, f: impl Fn(f64) -> f64) -> Self {
        match self {
            Self::Constant(x) => Self::Constant(f(x)),
            Self::PerRow(mut rows) => {
                rows.iter_mut().for_each(|x| *x = f(*x));
                Self::PerRow(rows)
            }
        }
    }

    fn zip(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        match (self, other) {
            (Self::Constant(x), Self::Constant(y)) => Self::Constant(f(x, y)),
            (Self::PerRow(rows), Self::Constant(y)) => Self::PerRow(rows).map(|x| f(x, y)),
            (Self::Constant(x), Self::PerRow(rows)) => Self::PerRow(rows).map(|y| f(x, y)),
            (Self::PerRow(mut rows), Self::PerRow(others)) => {
                rows.iter_mut().zip(others).for_each(|(x, y)| *x = f(*x, y));
                Self::PerRow(rows)
            }
        }
    }
}

/// Operators over [`Values`].
#[derive(Clone, Debug)]
pub(super) struct ColumnOperators;

fn power(x: f64, y: f64) -> f64 {
    if y == 2.0 { x * x } else { x.powf(y) }
}

impl MakeOperators<Values> for ColumnOperators {
    fn make<'a>() -> Vec<ExOperator<'a, Values>> {
        let both = |sign, apply: fn(Values, Values) -> Values| {
            // The text is fully bracketed, so priorities do not matter.
            ExOperator::make_bin(sign, BinOp { apply, prio: 0, is_commutative: false })
        };
        let one = |name, apply: fn(Values) -> Values| ExOperator::make_unary(name, apply);
        vec![
            both("+", |a, b| a.zip(b, |a, b| a + b)),
            both("-", |a, b| a.zip(b, |a, b| a - b)),
            both("*", |a, b| a.zip(b, |a, b| a * b)),
            both("/", |a, b| a.zip(b, |a, b| a / b)),
            both("^", |a, b| a.zip(b, power)),
            both("min", |a, b| a.zip(b, |a, b| if a < b || a.is_nan() { a } else { b })),
            both("max", |a, b| a.zip(b, |a, b| if a > b || a.is_nan() { a } else { b })),
            both("atan2", |a, b| a.zip(b, f64::atan2)),
            one("minus", |a| a.map(|a| -a)),
            one("sin", |a| a.map(f64::sin)),
            one("cos", |a| a.map(f64::cos)),
            one("tan", |a| a.map(f64::tan)),
            one("asin", |a| a.map(f64::asin)),
            one("acos", |a| a.map(f64::acos)),
            one("atan", |a| a.map(f64::atan)),
            one("sinh", |a| a.map(f64::sinh)),
            one("cosh", |a| a.map(f64::cosh)),
            one("tanh", |a| a.map(f64::tanh)),
            one("exp", |a| a.map(f64::exp)),
            one("ln", |a| a.map(f64::ln)),
            one("log10", |a| a.map(f64::log10)),
            one("sqrt", |a| a.map(f64::sqrt)),
            one("abs", |a| a.map(f64::abs)),
            one("sign", |a| a.map(|a| if a == 0.0 { 0.0 } else { a.signum() })),
        ]
    }
}

/// Functions of one argument, without state.
pub(super) const FUNCTIONS: [&str; 15] =
    ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "ln", "log10", "sqrt", "abs", "sign"];
/// Functions of two arguments, without state.
pub(super) const BINARY_FUNCTIONS: [&str; 3] = ["min", "max", "atan2"];
/// Functions with state, and the requirement on their second argument if they have one.
pub(super) const STATEFUL_FUNCTIONS: [(&str, Option<&str>); 5] = [
    ("lag", Some("a time in seconds, 0 or more")),
    ("lowpass", Some("a frequency in hertz above 0")),
    ("highpass", Some("a frequency in hertz above 0")),
    ("derivative", None),
    ("integral", None),
];

/// State of a function with memory.
#[derive(Clone, Debug)]
enum Filter {
    /// First-order lag, or input minus lag for `highpass`.
    Lag { lag: Box<Lags<1>>, highpass: bool },
    /// `(x_k − x_{k−1})/Δt`: the previous value and its time.
    Derivative { previous: f64, at_ns: i64 },
    /// Mean over the sample of `∫ x dt` from the first row: the integral so far.
    Integral { integral: f64 },
}

impl Filter {
    fn push(&mut self, time_ns: &[i64], input: &[f64], dt_s: f64) -> Vec<f64> {
        let mut out = Vec::with_capacity(input.len());
        match self {
            Self::Lag { lag, highpass } => {
                lag.push(time_ns, input, |_, rows| out.extend_from_slice(rows));
                if *highpass {
                    out.iter_mut().zip(input).for_each(|(low, x)| *low = x - *low);
                }
            }
            Self::Derivative { previous, at_ns } => {
                let step_ns = (dt_s * 1.5e9) as i64;
                for (&now_ns, &x) in time_ns.iter().zip(input) {
                    out.push(if now_ns - *at_ns < step_ns { (x - *previous) / dt_s } else { f64::NAN });
                    (*previous, *at_ns) = (x, now_ns);
                }
            }
            Self::Integral { integral } => {
                for x in input {
                    // A missing value counts as zero.
                    out.push(*integral + 0.5 * dt_s * x);
                    *integral += if x.is_finite() { dt_s * x } else { 0.0 };
                }
            }
        }
        out
    }

    fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        match self {
            Self::Lag { lag, .. } => lag.visit(state),
            Self::Derivative { previous, at_ns } => {
                state.f64(previous)?;
                state.i64(at_ns)
            }
            Self::Integral { integral } => state.f64(integral),
        }
    }
}

/// Source of an operand.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Operand {
    Number(f64),
    /// Input column, by its index in the program's names.
    Column(usize),
    /// Result of an earlier step.
    Step(usize),
}

/// A step of a program.
#[derive(Clone, Debug)]
enum Step {
    /// Expression, and its operands in the order of its variables.
    Arithmetic(Box<FlatEx<Values, ColumnOperators>>, Vec<Operand>),
    /// Function with state.
    Stateful(Filter, Operand),
}

/// A compiled formula.
#[derive(Clone, Debug)]
pub struct Program {
    names: Vec<String>,
    steps: Vec<Step>,
    result: Operand,
    dt_s: f64,
}

/// The three known names nearest to an unknown one.
fn nearest(name: &str, known: &[String]) -> String {
    let mut by_distance: Vec<(usize, &String)> = known.iter().map(|k| (edit_distance(name, k), k)).collect();
    by_distance.sort();
    let all: Vec<String> = by_distance.iter().take(3).map(|(_, k)| format!("`{k}`")).collect();
    all.join(", ")
}

/// Edit distance between two names (Levenshtein).
fn edit_distance(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut corner = row[0];
        row[0] = i + 1;
        for (j, y) in b.bytes().enumerate() {
            let replaced = corner + usize::from(x != y);
            corner = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(corner + 1);
        }
    }
    row[b.len()]
}

/// Expression under construction.
#[derive(Default)]
struct Expression {
    text: String,
    operands: Vec<Operand>,
}

impl Expression {
    /// Appends an operand. `exmex` sorts variables by name; leading zeros keep their order.
    fn operand(&mut self, operand: Operand) {
        let same = |o: &Operand| *o == operand;
        let i = self.operands.iter().position(same).unwrap_or_else(|| {
            self.operands.push(operand);
            self.operands.len() - 1
        });
        self.text.push_str(&format!("v{i:04}"));
    }
}

struct Compiler<'a> {
    known: &'a [String],
    names: Vec<String>,
    steps: Vec<Step>,
    dt_s: f64,
}

fn refused(error: &ExError) -> TextError {
    TextError::new(format!("the formula cannot be evaluated: {error}"), 0)
}

impl Compiler<'_> {
    /// Compiles a tree into an expression over the results of earlier steps.
    fn arithmetic(&mut self, tree: &Tree, out: &mut Expression) -> Result<(), TextError> {
        match tree {
            Tree::Number(number) => out.operand(Operand::Number(*number)),
            Tree::Name(name, at) => {
                let operand = self.name(name, *at)?;
                out.operand(operand);
            }
            Tree::Negate(inner) => {
                out.text.push_str("minus(");
                self.arithmetic(inner, out)?;
                out.text.push(')');
            }
            Tree::Binary(operator, a, b) => self.binary(&operator.sign().to_string(), a, b, out)?,
            Tree::Call(function, arguments, at) => self.call(function, arguments, *at, out)?,
        }
        Ok(())
    }

    fn binary(&mut self, sign: &str, a: &Tree, b: &Tree, out: &mut Expression) -> Result<(), TextError> {
        out.text.push('(');
        self.arithmetic(a, out)?;
        out.text.push_str(&format!(" {sign} "));
        self.arithmetic(b, out)?;
        out.text.push(')');
        Ok(())
    }

    fn name(&mut self, name: &str, at: usize) -> Result<Operand, TextError> {
        if name == "pi" {
            return Ok(Operand::Number(PI));
        }
        if !self.known.iter().any(|k| k == name) {
            return Err(TextError::new(
                format!("unknown name `{name}`; the nearest: {}", nearest(name, self.known)),
                at,
            ));
        }
        let i = self.names.iter().position(|n| n == name).unwrap_or_else(|| {
            self.names.push(name.to_owned());
            self.names.len() - 1
        });
        Ok(Operand::Column(i))
    }

    fn call(&mut self, function: &str, arguments: &[Tree], at: usize, out: &mut Expression) -> Result<(), TextError> {
        let count = |wanted: usize| {
            let plural = if wanted == 1 { "" } else { "s" };
            if arguments.len() == wanted {
                Ok(())
            } else {
                Err(TextError::new(
                    format!("`{function}` takes {wanted} argument{plural}, not {}", arguments.len()),
                    at,
                ))
            }
        };
        if FUNCTIONS.contains(&function) {
            count(1)?;
            out.text.push_str(&format!("{function}("));
            self.arithmetic(&arguments[0], out)?;
            out.text.push(')');
            Ok(())
        } else if BINARY_FUNCTIONS.contains(&function) {
            count(2)?;
            self.binary(function, &arguments[0], &arguments[1], out)
        } else if let Some((_, second)) = STATEFUL_FUNCTIONS.iter().find(|(name, _)| *name == function) {
            count(1 + usize::from(second.is_some()))?;
            let number = match (second, arguments.get(1)) {
                (Some(wanted), Some(argument)) => self.constant(function, argument, wanted, at)?,
                _ => 0.0,
            };
            let filter = self.filter(function, number);
            let input = self.operand(&arguments[0])?;
            self.steps.push(Step::Stateful(filter, input));
            out.operand(Operand::Step(self.steps.len() - 1));
            Ok(())
        } else {
            let all = FUNCTIONS.iter().chain(&BINARY_FUNCTIONS).chain(STATEFUL_FUNCTIONS.iter().map(|(name, _)| name));
            let all: Vec<String> = all.map(|name| (*name).to_owned()).collect();
            Err(TextError::new(format!("unknown function `{function}`; the nearest: {}", nearest(function, &all)), at))
        }
    }

    fn filter(&self, function: &str, number: f64) -> Filter {
        let lag = |lag_s: f64, highpass: bool| Filter::Lag { lag: Box::new(Lags::new([lag_s], self.dt_s)), highpass };
        match function {
            "lag" => lag(number, false),
            "lowpass" => lag(1.0 / (TAU * number), false),
            "highpass" => lag(1.0 / (TAU * number), true),
            "derivative" => Filter::Derivative { previous: f64::NAN, at_ns: i64::MIN / 2 },
            _ => Filter::Integral { integral: 0.0 },
        }
    }

    /// Value of an argument that contains no names.
    ///
    /// # Errors
    /// The argument is not constant, or out of range.
    fn constant(&mut self, function: &str, tree: &Tree, wanted: &str, at: usize) -> Result<f64, TextError> {
        let refuse = || TextError::new(format!("the second argument of `{function}` must be {wanted}"), at);
        let previous = (self.names.len(), self.steps.len());
        let value = match self.operand(tree)? {
            Operand::Number(number) => number,
            _ if (self.names.len(), self.steps.len()) != (previous.0, previous.1 + 1) => return Err(refuse()),
            _ => match self.steps.pop() {
                Some(Step::Arithmetic(expression, operands))
                    if operands.iter().all(|o| matches!(o, Operand::Number(_))) =>
                {
                    match evaluate(&expression, &operands, |_| Values::default()).map_err(|e| refused(&e))? {
                        Values::Constant(number) => number,
                        Values::PerRow(_) => f64::NAN,
                    }
                }
                _ => return Err(refuse()),
            },
        };
        let fits = if function == "lag" { (0.0..=1e7).contains(&value) } else { value > 0.0 && value <= 1e6 };
        if fits { Ok(value) } else { Err(refuse()) }
    }

    /// Compiles a tree into an operand: a number, a column, or the result of a step.
    fn operand(&mut self, tree: &Tree) -> Result<Operand, TextError> {
        let mut expression = Expression::default();
        self.arithmetic(tree, &mut expression)?;
        if let ([operand], "v0000") = (&*expression.operands, &*expression.text) {
            return Ok(*operand);
        }
        let parsed = FlatEx::parse(&expression.text).map_err(|e| refused(&e))?;
        self.steps.push(Step::Arithmetic(Box::new(parsed), expression.operands));
        Ok(Operand::Step(self.steps.len() - 1))
    }
}

fn evaluate(
    expression: &FlatEx<Values, ColumnOperators>,
    operands: &[Operand],
    mut values: impl FnMut(&Operand) -> Values,
) -> ExResult<Values> {
    let of = |operand: &Operand| match operand {
        Operand::Number(number) => Values::Constant(*number),
        other => values(other),
    };
    expression.eval_vec(operands.iter().map(of).collect())
}

impl Program {
    /// Compiles a tree over known names; `dt_s` is the sample interval, s.
    ///
    /// # Errors
    /// [`TextError`] for an unknown name or function, or invalid arguments.
    pub fn new(tree: &Tree, known: &[String], dt_s: f64) -> Result<Self, TextError> {
        let mut compiler = Compiler { known, names: Vec::new(), steps: Vec::new(), dt_s };
        let result = compiler.operand(tree)?;
        Ok(Self { names: compiler.names, steps: compiler.steps, result, dt_s })
    }

    /// Names of the columns that [`Self::push`] takes, in order.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Appends the formula's value per row to `out`; `columns` in the order of [`Self::names`], `time_ns` in Unix ns.
    ///
    /// # Errors
    /// An internal inconsistency of `exmex`; no formula causes it.
    pub fn push(&mut self, time_ns: &[i64], columns: &[&[f64]], out: &mut Vec<f64>) -> ExResult<()> {
        let mut made: Vec<Values> = Vec::with_capacity(self.steps.len());
        for (chunk, times) in time_ns.chunks(CHUNK_ROWS).enumerate() {
            let rows = chunk * CHUNK_ROWS..chunk * CHUNK_ROWS + times.len();
            made.clear();
            for step in &mut self.steps {
                // Each result is used once.
                let mut values = |operand: &Operand| match *operand {
                    Operand::Number(number) => Values::Constant(number),
                    Operand::Column(i) => Values::PerRow(columns[i][rows.clone()].to_vec()),
                    Operand::Step(i) => std::mem::take(&mut made[i]),
                };
                let next = match step {
                    Step::Arithmetic(expression, operands) => evaluate(expression, operands, values)?,
                    Step::Stateful(filter, Operand::Column(i)) => {
                        Values::PerRow(filter.push(times, &columns[*i][rows.clone()], self.dt_s))
                    }
                    Step::Stateful(filter, operand) => {
                        Values::PerRow(filter.push(times, &per_row(values(operand), times.len()), self.dt_s))
                    }
                };
                made.push(next);
            }
            match self.result {
                Operand::Number(number) => out.extend(std::iter::repeat_n(number, times.len())),
                Operand::Column(i) => out.extend_from_slice(&columns[i][rows]),
                Operand::Step(_) => out.append(&mut per_row(made.pop().unwrap_or_default(), times.len())),
            }
        }
        Ok(())
    }

    /// Visits all that the next rows depend on.
    ///
    /// # Errors
    /// The state ends.
    pub fn visit(&mut self, state: &mut State<'_>) -> Result<(), StateError> {
        let mut filters =
            self.steps.iter_mut().filter_map(|s| if let Step::Stateful(filter, _) = s { Some(filter) } else { None });
        filters.try_for_each(|filter| filter.visit(state))
    }
}

/// Expands to one value per row.
fn per_row(values: Values, rows: usize) -> Vec<f64> {
    match values {
        Values::Constant(number) => vec![number; rows],
        Values::PerRow(rows) => rows,
    }
}

#[cfg(test)]
mod tests {
    use super::super::text::{Operator, parse, tests::trees};
    use super::*;
    use dragfree_sdk::state;
    use proptest::prelude::*;

    const DT_S: f64 = 0.1;
    const NAMES: &[&str] = &["hk.a", "hk.b", "alpha.x"];

    fn known() -> Vec<String> {
        NAMES.iter().map(|n| (*n).to_owned()).collect()
    }

    fn program(text: &str) -> Program {
        let made = parse(text).and_then(|tree| Program::new(&tree, &known(), DT_S));
        made.unwrap_or_else(|e| panic!("{}", e.marked(text)))
    }

    fn times(rows: usize) -> Vec<i64> {
        (0..rows as i64).map(|k| 2_000_000_000_000_000_000 + k * 100_000_000).collect()
    }

    /// Runs a program on the columns of its names.
    fn run(program: &mut Program, time_ns: &[i64], all: &[Vec<f64>; 3]) -> Vec<f64> {
        let columns: Vec<&[f64]> =
            program.names().iter().map(|n| &*all[NAMES.iter().position(|k| k == n).unwrap()]).collect();
        let mut out = Vec::new();
        program.push(time_ns, &columns, &mut out).unwrap();
        out
    }

    fn columns(rows: usize) -> [Vec<f64>; 3] {
        let column = |f: fn(f64) -> f64| (0..rows).map(|k| f(0.01 * k as f64)).collect();
        [column(|t| 294.0 + t.sin()), column(|t| 290.0 + (1.7 * t).cos()), column(|t| (31.0 * t).sin())]
    }

    /// Reference: recursive evaluation row by row.
    fn evaluate_row(tree: &Tree, row: &[f64; 3]) -> f64 {
        match tree {
            Tree::Number(x) => *x,
            Tree::Name(name, _) => row[NAMES.iter().position(|n| n == name).unwrap()],
            Tree::Negate(inner) => -evaluate_row(inner, row),
            Tree::Binary(operator, a, b) => {
                let (a, b) = (evaluate_row(a, row), evaluate_row(b, row));
                match operator {
                    Operator::Add => a + b,
                    Operator::Subtract => a - b,
                    Operator::Multiply => a * b,
                    Operator::Divide => a / b,
                    Operator::Power => power(a, b),
                }
            }
            Tree::Call(name, arguments, _) => {
                let x = evaluate_row(&arguments[0], row);
                match name.as_str() {
                    "sin" => x.sin(),
                    "abs" => x.abs(),
                    _ => x.exp(),
                }
            }
        }
    }

    proptest! {
        #[test]
        fn arithmetic_matches_recursive_evaluation(tree in trees(NAMES)) {
            let all = columns(30);
            let mut program = Program::new(&tree, &known(), DT_S).unwrap();
            let got = run(&mut program, &times(30), &all);
            for k in 0..30 {
                let want = evaluate_row(&tree, &[all[0][k], all[1][k], all[2][k]]);
                prop_assert!(got[k].to_bits() == want.to_bits() || got[k].is_nan() && want.is_nan(), "{} {}", got[k], want);
            }
        }

        /// Splitting the rows and saving the state in between leaves the output bit by bit the same.
        #[test]
        fn chunks_and_saved_states_do_not_change_the_output(cut in 0_usize..3000) {
            let text = "lag(hk.a - lowpass(hk.b, 0.01), 33) * derivative(alpha.x) + integral(highpass(alpha.x, 0.3)) ^ 2";
            let (all, time_ns) = (columns(3000), times(3000));
            let whole = run(&mut program(text), &time_ns, &all);
            let part = |from: usize, to: usize| all.clone().map(|c| c[from..to].to_vec());
            let mut first = program(text);
            let mut out = run(&mut first, &time_ns[..cut], &part(0, cut));
            let mut second = program(text);
            let saved = state::save("program", 1, |state| first.visit(state)).expect("saved");
            state::load("program", 1, &saved, |state| second.visit(state)).expect("its own state");
            out.extend(run(&mut second, &time_ns[cut..], &part(cut, 3000)));
            prop_assert!(whole.iter().zip(&out).all(|(a, b)| a.to_bits() == b.to_bits()) && whole.len() == out.len());
        }

        #[test]
        fn no_tree_makes_the_compiler_panic(text in "[-+*/^(), 0-9a-z.]{0,60}") {
            if let Ok(tree) = parse(&text) {
                let _ = Program::new(&tree, &known(), DT_S);
            }
        }
    }

    /// Reference: recursions written out row by row.
    #[test]
    fn stateful_functions_match_explicit_recursions() {
        let (all, time_ns) = (columns(2000), times(2000));
        let x = &all[2];
        let derivative = run(&mut program("derivative(alpha.x)"), &time_ns, &all);
        assert!(derivative[0].is_nan());
        assert!((1..2000).all(|k| derivative[k] == (x[k] - x[k - 1]) / DT_S));
        let integral = run(&mut program("integral(alpha.x)"), &time_ns, &all);
        let mut sum = 0.0;
        for k in 0..2000 {
            assert!((integral[k] - (sum + 0.5 * DT_S * x[k])).abs() < 1e-12);
            sum += DT_S * x[k];
        }
        let high = run(&mut program("highpass(alpha.x, 0.2)"), &time_ns, &all);
        let low = run(&mut program("lowpass(alpha.x, 0.2)"), &time_ns, &all);
        let lag = run(&mut program("lag(alpha.x, 1 / (2 * pi * 0.2))"), &time_ns, &all);
        let mut y = x[0];
        let tau = 1.0 / (TAU * 0.2);
        for k in 0..2000 {
            let next = x[k] + (y - x[k]) * (-DT_S / tau).exp();
            // Mean of an exponential: its change over its rate.
            let mean = x[k] + (y - next) * tau / DT_S;
            assert!((low[k] - mean).abs() < 1e-12 && low[k] == lag[k] && high[k] == x[k] - low[k]);
            y = next;
        }
        let of_product = run(&mut program("lag(hk.a * hk.b, 0)"), &time_ns, &all);
        assert!((0..2000).all(|k| of_product[k] == all[0][k] * all[1][k]));
        assert_eq!(run(&mut program("max(2, 3) + min(hk.a, 1)"), &time_ns[..1], &columns(1)), [4.0]);
        assert_eq!(run(&mut program("7"), &time_ns[..2], &columns(2)), [7.0, 7.0]);
        assert_eq!(run(&mut program("hk.a"), &time_ns, &all), all[0]);
    }

    #[test]
    fn a_derivative_is_undefined_after_a_gap() {
        let mut time_ns = times(10);
        time_ns[5..].iter_mut().for_each(|t| *t += 400_000_000);
        let got = run(&mut program("derivative(hk.a)"), &time_ns, &columns(10));
        assert!((0..10).all(|k| got[k].is_nan() == (k == 0 || k == 5)));
    }

    #[test]
    fn invalid_names_and_arguments_are_located() {
        for (text, at, part) in [
            ("hk.a * alfa.x", 7, "unknown name `alfa.x`; the nearest: `alpha.x`"),
            ("1 + lagg(hk.a, 3)", 4, "unknown function `lagg`; the nearest: `lag`"),
            ("sin(hk.a, 2)", 0, "takes 1 argument, not 2"),
            ("2*lag(hk.a)", 2, "takes 2 arguments, not 1"),
            ("lag(hk.a, hk.b)", 0, "must be a time in seconds"),
            ("lag(hk.a, lag(3, 4))", 0, "must be a time in seconds"),
            ("lag(hk.a, -1)", 0, "must be a time in seconds"),
            ("lowpass(hk.a, 0)", 0, "above 0"),
        ] {
            let error = Program::new(&parse(text).unwrap(), &known(), DT_S).expect_err(text);
            assert!(error.at == at && error.what.contains(part), "{text}: {error:?}");
        }
    }
}
