//! Splits an expression into its words.

use std::fmt;

/// One word.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Token<'t> {
    Number(f64),
    Name(&'t str),
    Sign(&'static str),
    End,
}

impl fmt::Display for Token<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Token::Number(x) => write!(f, "{x}"),
            Token::Name(name) => f.write_str(name),
            Token::Sign(sign) => f.write_str(sign),
            Token::End => f.write_str("the end"),
        }
    }
}

/// Longer ones first.
const SIGNS: [&str; 15] = ["<=", ">=", "==", "!=", "<", ">", "+", "-", "*", "/", "^", "(", ")", ",", "="];

/// An expression as it is shown in a message: of a long one, its begin.
pub(super) fn quoted(text: &str) -> String {
    const SHOWN: usize = 200;
    match text.char_indices().nth(SHOWN) {
        Some((at, _)) => format!("{}...", &text[..at]),
        None => text.to_owned(),
    }
}

/// Words of one expression at most.
const MOST: usize = 10_000;

/// The words of a text with their places, counted in characters from 1.
pub(super) struct Lexer<'t> {
    tokens: Vec<(usize, Token<'t>)>,
    at: usize,
}

impl<'t> Lexer<'t> {
    /// # Errors
    /// A sentence about the first thing that is no word.
    pub(super) fn new(text: &'t str) -> Result<Self, String> {
        let (mut tokens, mut rest, mut at) = (Vec::new(), text, 1);
        loop {
            let word = rest.trim_start();
            at += rest[..rest.len() - word.len()].chars().count();
            rest = word;
            if tokens.len() == MOST {
                return Err(format!("it has more than {MOST} words; split it into several terms"));
            }
            let Some(first) = rest.chars().next() else {
                tokens.push((at, Token::End));
                return Ok(Lexer { tokens, at: 0 });
            };
            let (token, length) = if first == '{' {
                let end = rest.find('}').ok_or_else(|| format!("'{{' at character {at} is not closed"))?;
                (Token::Name(rest[1..end].trim()), end + 1)
            } else if first.is_ascii_digit() || first == '.' {
                let length = number_length(rest);
                let word = &rest[..length];
                let value =
                    word.parse().map_err(|_| format!("'{word}' at character {at} is not a number"))?;
                (Token::Number(value), length)
            } else if first.is_alphabetic() || first == '_' {
                let inside = |c: char| c.is_alphanumeric() || c == '_' || c == '.';
                let length = rest.find(|c| !inside(c)).unwrap_or(rest.len());
                (Token::Name(&rest[..length]), length)
            } else {
                let sign = SIGNS.iter().find(|s| rest.starts_with(**s));
                let sign = sign.ok_or_else(|| format!("'{first}' at character {at} means nothing here"))?;
                (Token::Sign(sign), sign.len())
            };
            tokens.push((at, token));
            at += rest[..length].chars().count();
            rest = &rest[length..];
        }
    }

    /// The next word; the end again and again.
    pub(super) fn next(&mut self) -> (usize, Token<'t>) {
        let (at, token) = self.tokens[self.at];
        self.at = (self.at + 1).min(self.tokens.len() - 1);
        (at, token)
    }

    /// The next word with its place, in quotes but for the end.
    pub(super) fn peek(&self) -> (usize, String) {
        match self.tokens[self.at] {
            (at, Token::End) => (at, "the end".into()),
            (at, token) => (at, format!("'{token}'")),
        }
    }

    /// Takes the next word if it is this one.
    pub(super) fn take(&mut self, word: &str) -> bool {
        let is = match self.tokens[self.at].1 {
            Token::Sign(sign) => sign == word,
            Token::Name(name) => name == word,
            _ => false,
        };
        if is {
            self.next();
        }
        is
    }

    /// Takes the next word if it is one of these.
    pub(super) fn take_any<T: Copy>(&mut self, words: &[(&'static str, T)]) -> Option<(&'static str, T)> {
        words.iter().find(|(word, _)| self.take(word)).copied()
    }
}

/// Digits and dots, with an exponent.
fn number_length(text: &str) -> usize {
    let digits = |from: usize| {
        text[from..].find(|c: char| !c.is_ascii_digit() && c != '.').map_or(text.len(), |n| from + n)
    };
    let end = digits(0);
    let Some(after) = text[end..].strip_prefix(['e', 'E']) else { return end };
    let signed = after.strip_prefix(['+', '-']).unwrap_or(after);
    if signed.starts_with(|c: char| c.is_ascii_digit()) { digits(text.len() - signed.len()) } else { end }
}
