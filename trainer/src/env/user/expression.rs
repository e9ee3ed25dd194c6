//! Arithmetic of a task file, compiled once to a postfix program; evaluating it allocates nothing.
//!
//! ```text
//! + - * / ^   < <= > >= == !=   and or not   if(c, a, b)   min max atan2 clamp(x, low, high)
//! abs sign sqrt exp log sin cos tan tanh floor   numbers, pi, names
//! ```
//!
//! Precedence is that of mathematics: `-x^2` is `-(x^2)`, `2^3^2` is `2^(3^2)`. A comparison is 1 where it holds and 0
//! elsewhere; whatever is not 0 counts as true. A name that holds other signs than letters, digits, `_` and `.` is written in
//! braces: `{q.left-hip}`.

use super::lexer::{Lexer, Token};

/// Numbers an evaluation may have in flight.
const DEPTH: usize = 32;

#[derive(Debug, Clone, Copy)]
enum Op<Q> {
    Number(f64),
    Load(Q),
    One(fn(f64) -> f64),
    Two(fn(f64, f64) -> f64),
    Three(fn(f64, f64, f64) -> f64),
}

impl<Q> Op<Q> {
    fn takes(&self) -> usize {
        match self {
            Op::Number(_) | Op::Load(_) => 0,
            Op::One(_) => 1,
            Op::Two(_) => 2,
            Op::Three(_) => 3,
        }
    }
}

/// A compiled expression over quantities `Q`.
#[derive(Debug, Clone)]
pub(super) struct Expression<Q>(Vec<Op<Q>>);

impl<Q: Copy> Expression<Q> {
    /// Compiles `text`; `resolve` turns a name into a quantity, or says in a sentence why it cannot.
    ///
    /// # Errors
    /// A sentence with the place in the text, counted in characters from 1.
    pub(super) fn parse(text: &str, resolve: impl Fn(&str) -> Result<Q, String>) -> Result<Self, String> {
        let mut parser =
            Parser { lexer: Lexer::new(text)?, resolve, program: Vec::new(), depth: 0, nesting: 0 };
        parser.either()?;
        match parser.lexer.next() {
            (_, Token::End) => match Expression(parser.program) {
                e if e.constant().is_some_and(|x| !x.is_finite()) => {
                    Err(format!("it is {} always; look for a logarithm, root or quotient", e.value(|_| 0.0)))
                }
                e => Ok(e),
            },
            (at, token) => Err(format!(
                "'{token}' at character {at} follows a complete expression; is an operator missing?"
            )),
        }
    }

    /// The quantities it names.
    pub(super) fn quantities(&self) -> impl Iterator<Item = Q> {
        self.0.iter().filter_map(|op| if let Op::Load(quantity) = op { Some(*quantity) } else { None })
    }

    /// Its value, where it names no quantity.
    pub(super) fn constant(&self) -> Option<f64> {
        self.quantities().next().is_none().then(|| self.value(|_| 0.0))
    }

    /// The value where `read` gives each quantity its own.
    pub(super) fn value(&self, read: impl Fn(Q) -> f64) -> f64 {
        let (mut stack, mut top) = ([0.0; DEPTH], 0);
        for op in &self.0 {
            top -= op.takes();
            stack[top] = match *op {
                Op::Number(x) => x,
                Op::Load(quantity) => read(quantity),
                Op::One(f) => f(stack[top]),
                Op::Two(f) => f(stack[top], stack[top + 1]),
                Op::Three(f) => f(stack[top], stack[top + 1], stack[top + 2]),
            };
            top += 1;
        }
        stack[0]
    }

    /// Whether the value counts as true: neither 0 nor NaN.
    pub(super) fn holds(&self, read: impl Fn(Q) -> f64) -> bool {
        truth(self.value(read))
    }
}

fn truth(x: f64) -> bool {
    x != 0.0 && !x.is_nan()
}

fn number(holds: bool) -> f64 {
    f64::from(u8::from(holds))
}

/// Signs of the same precedence.
type Operators = &'static [(&'static str, fn(f64, f64) -> f64)];

const COMPARISONS: Operators = &[
    ("<", |a, b| number(a < b)),
    ("<=", |a, b| number(a <= b)),
    (">", |a, b| number(a > b)),
    (">=", |a, b| number(a >= b)),
    ("==", |a, b| number(a == b)),
    ("!=", |a, b| number(a != b)),
];
const SUMS: Operators = &[("+", |a, b| a + b), ("-", |a, b| a - b)];
const PRODUCTS: Operators = &[("*", |a, b| a * b), ("/", |a, b| a / b)];

enum Function {
    One(fn(f64) -> f64),
    Two(fn(f64, f64) -> f64),
    Three(fn(f64, f64, f64) -> f64),
}

const FUNCTIONS: &[(&str, Function)] = &[
    ("abs", Function::One(f64::abs)),
    ("sign", Function::One(|x| if x == 0.0 { 0.0 } else { x.signum() })),
    ("sqrt", Function::One(f64::sqrt)),
    ("exp", Function::One(f64::exp)),
    ("log", Function::One(f64::ln)),
    ("sin", Function::One(f64::sin)),
    ("cos", Function::One(f64::cos)),
    ("tan", Function::One(f64::tan)),
    ("tanh", Function::One(f64::tanh)),
    ("floor", Function::One(f64::floor)),
    ("min", Function::Two(f64::min)),
    ("max", Function::Two(f64::max)),
    ("atan2", Function::Two(f64::atan2)),
    ("clamp", Function::Three(|x, low, high| x.max(low).min(high))),
    ("if", Function::Three(|c, a, b| if truth(c) { a } else { b })),
];

/// Recursive descent, loosest operator first.
struct Parser<'t, Q, R> {
    lexer: Lexer<'t>,
    resolve: R,
    program: Vec<Op<Q>>,
    depth: usize,
    nesting: usize,
}

impl<Q: Copy, R: Fn(&str) -> Result<Q, String>> Parser<'_, Q, R> {
    fn push(&mut self, op: Op<Q>) -> Result<(), String> {
        self.depth = self.depth + 1 - op.takes();
        self.program.push(op);
        if self.depth > DEPTH {
            return Err(format!("it has more than {DEPTH} numbers in flight; split it into several terms"));
        }
        Ok(())
    }

    fn either(&mut self) -> Result<(), String> {
        self.both()?;
        while self.lexer.take("or") {
            self.both()?;
            self.push(Op::Two(|a, b| number(truth(a) || truth(b))))?;
        }
        Ok(())
    }

    fn both(&mut self) -> Result<(), String> {
        self.inverted()?;
        while self.lexer.take("and") {
            self.inverted()?;
            self.push(Op::Two(|a, b| number(truth(a) && truth(b))))?;
        }
        Ok(())
    }

    fn inverted(&mut self) -> Result<(), String> {
        if self.lexer.take("not") {
            return self.nested(|p| {
                p.inverted()?;
                p.push(Op::One(|x| number(!truth(x))))
            });
        }
        self.comparison()
    }

    /// `a < b`; `a < b < c` would not mean what it looks like.
    fn comparison(&mut self) -> Result<(), String> {
        self.sum()?;
        let Some((_, compare)) = self.lexer.take_any(COMPARISONS) else { return Ok(()) };
        self.sum()?;
        self.push(Op::Two(compare))?;
        match self.lexer.take_any(COMPARISONS) {
            None => Ok(()),
            Some((sign, _)) => Err(format!("a second comparison '{sign}' in a row; write 'a < b and b < c'")),
        }
    }

    fn sum(&mut self) -> Result<(), String> {
        self.product()?;
        while let Some((_, operate)) = self.lexer.take_any(SUMS) {
            self.product()?;
            self.push(Op::Two(operate))?;
        }
        Ok(())
    }

    fn product(&mut self) -> Result<(), String> {
        self.signed()?;
        while let Some((_, operate)) = self.lexer.take_any(PRODUCTS) {
            self.signed()?;
            self.push(Op::Two(operate))?;
        }
        Ok(())
    }

    fn signed(&mut self) -> Result<(), String> {
        if self.lexer.take("-") {
            return self.nested(|p| {
                p.signed()?;
                p.push(Op::One(|x| -x))
            });
        }
        self.power()
    }

    fn power(&mut self) -> Result<(), String> {
        self.atom()?;
        if self.lexer.take("^") {
            self.nested(Self::signed)?;
            // x * x and not pow: the same bits as a hand-written square
            self.push(Op::Two(|x, n| if n == 2.0 { x * x } else { x.powf(n) }))?;
        }
        Ok(())
    }

    fn atom(&mut self) -> Result<(), String> {
        match self.lexer.next() {
            (_, Token::Number(x)) => self.push(Op::Number(x)),
            (_, Token::Sign("(")) => {
                self.nested(Self::either)?;
                self.expect(")")
            }
            (_, Token::Name("pi")) => self.push(Op::Number(std::f64::consts::PI)),
            (at, Token::Name(name)) if self.lexer.take("(") => self.call(name, at),
            (at, Token::Name(name)) => {
                let quantity = (self.resolve)(name).map_err(|e| format!("{e} (character {at})"))?;
                self.push(Op::Load(quantity))
            }
            (at, Token::End) => Err(format!("it ends at character {at} where a number or a name is missing")),
            (at, token) => Err(format!("'{token}' at character {at} is no number and no name")),
        }
    }

    fn call(&mut self, name: &str, at: usize) -> Result<(), String> {
        let Some((_, function)) = FUNCTIONS.iter().find(|(n, _)| *n == name) else {
            let known: Vec<_> = FUNCTIONS.iter().map(|(n, _)| *n).collect();
            return Err(format!(
                "there is no function '{name}' (character {at}); use one of {}",
                known.join(", ")
            ));
        };
        let (op, wanted) = match *function {
            Function::One(f) => (Op::One(f), 1),
            Function::Two(f) => (Op::Two(f), 2),
            Function::Three(f) => (Op::Three(f), 3),
        };
        for argument in 0..wanted {
            if argument > 0 {
                self.expect(",").map_err(|e| format!("{e}; {name} takes {wanted} arguments"))?;
            }
            self.nested(Self::either)?;
        }
        self.expect(")").map_err(|e| {
            format!("{e}; {name} takes {wanted} argument{}", if wanted == 1 { "" } else { "s" })
        })?;
        self.push(op)
    }

    fn expect(&mut self, sign: &str) -> Result<(), String> {
        match self.lexer.take(sign) {
            true => Ok(()),
            false => {
                let (at, found) = self.lexer.peek();
                Err(format!("'{sign}' is missing before {found} at character {at}"))
            }
        }
    }

    /// The descent is recursive: a bound keeps a hostile file from exhausting the stack.
    fn nested(&mut self, inner: impl FnOnce(&mut Self) -> Result<(), String>) -> Result<(), String> {
        self.nesting += 1;
        if self.nesting > 200 {
            return Err("it is nested more than 200 deep; simplify it".into());
        }
        inner(self)?;
        self.nesting -= 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::Expression;

    fn value(text: &str) -> f64 {
        compile(text).unwrap_or_else(|e| panic!("{text}: {e}")).value(|x| x)
    }

    /// `x` is 3, `y.a` is 0.5.
    fn compile(text: &str) -> Result<Expression<f64>, String> {
        Expression::parse(text, |name| match name {
            "x" => Ok(3.0),
            "y.a" | "y-b" => Ok(0.5),
            other => Err(format!("unknown name '{other}'")),
        })
    }

    #[test]
    fn precedence_is_that_of_mathematics() {
        for (text, expected) in [
            ("1 + 2 * x", 7.0),
            ("-x^2", -9.0),
            ("2^3^2", 512.0),
            ("2^-1", 0.5),
            ("10 - 4 - 3", 3.0),
            ("12 / 4 / 3", 1.0),
            ("-2 * -x", 6.0),
            ("1e-3 * 2.5E2", 0.25),
            (".5 + 1.", 1.5),
            ("x < 4 and not x < 2", 1.0),
            ("x > 4 or y.a == 0.5", 1.0),
            ("not (x > 4 or x < 5) + 1", 0.0),
            ("1 + (x >= 3) * 2", 3.0),
            ("if(x > 2, y.a, 9)", 0.5),
            ("clamp(x, -1, 1) + min(x, 1) + max(x, 5) + {y-b}", 7.5),
            ("atan2(1, 0) - pi / 2 + abs(-x) + sign(-2)", 2.0),
            ("sin(x)^2 + cos(x)^2 + exp(log(2)) + sqrt(4) + tanh(0) + floor(1.9) + tan(0)", 6.0),
        ] {
            assert!((value(text) - expected).abs() < 1e-15, "{text} is {}", value(text));
        }
    }

    #[test]
    fn what_is_not_a_number_is_not_true() {
        let e = compile("(0 / 0) > 1").expect("an expression");
        assert!(!e.holds(|x| x) && !compile("(x - 3) / 0").expect("an expression").holds(|x| x));
        assert!(compile("-2").expect("an expression").holds(|x| x));
    }

    #[test]
    fn mistakes_are_named_with_their_place() {
        for (text, words) in [
            ("1 + zz", "unknown name 'zz' (character 5)"),
            ("1 +", "ends at character 4"),
            ("1 x", "'x' at character 3 follows a complete expression"),
            ("(1 + 2", "')' is missing before the end at character 7"),
            ("min(1)", "',' is missing before ')' at character 6; min takes 2 arguments"),
            ("abs(1, 2)", "abs takes 1 argument"),
            ("sine(1)", "there is no function 'sine'"),
            ("1 < x < 3", "write 'a < b and b < c'"),
            ("1 $ 2", "'$' at character 3"),
            ("{x", "'{' at character 1 is not closed"),
            ("", "ends at character 1"),
            ("1.2.3", "'1.2.3' at character 1 is not a number"),
            ("2 * log(-1)", "it is NaN always"),
        ] {
            let message = compile(text).expect_err(text);
            assert!(message.contains(words), "{text}: {message}");
        }
        let deep = format!("{}1{}", "(".repeat(2000), ")".repeat(2000));
        assert!(compile(&deep).expect_err("deep").contains("200 deep"));
        let wide = (0..40).fold(String::from("1"), |e, _| format!("1 + ({e})"));
        assert!(compile(&wide).expect_err("wide").contains("in flight"));
    }
}
