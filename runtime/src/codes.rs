//! Every code a program of this workspace prints, with what it means and what to do: the text behind `nearl explain`.
//!
//! A code is declared once, with its enum variant, by a macro of this module; [`all`] walks them.

/// Declares an enum whose variants carry a stable name, a meaning and a remedy. The number of a variant is its place.
macro_rules! codes {
    ($(#[$meta:meta])* $name:ident, $group:literal { $($variant:ident = $code:literal, $meaning:literal, $remedy:literal;)+ }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
        pub enum $name {
            $(#[doc = $meaning] #[serde(rename = $code)] $variant,)+
        }

        impl $name {
            /// All of them, in the order of their numbers.
            pub const ALL: &'static [$name] = &[$($name::$variant),+];

            /// The number in a message.
            pub fn code(self) -> u32 {
                self as u32
            }

            /// The stable name, as logs and `nearl explain` have it.
            pub fn name(self) -> &'static str {
                match self { $($name::$variant => $code,)+ }
            }

            /// Name, meaning and remedy.
            pub fn explanation(self) -> $crate::codes::Explanation {
                match self {
                    $($name::$variant => $crate::codes::Explanation {
                        code: $code, group: $group, meaning: $meaning, remedy: $remedy,
                    },)+
                }
            }

            pub(crate) fn explanations() -> Vec<$crate::codes::Explanation> {
                Self::ALL.iter().map(|code| code.explanation()).collect()
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}
pub(crate) use codes;

mod tables;

pub use tables::{CheckCode, LedgerStatus, LinkCode, SnapshotCode};

use crate::link::Verdict;
use crate::rt::{Mode, Reason};

/// What a code means and what to do about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Explanation {
    /// Stable name.
    pub code: &'static str,
    /// Where it appears: `mode`, `reason`, `status`, `verdict`, `snapshot`, `link`, `doctor` or `rollout`.
    pub group: &'static str,
    /// What happened.
    pub meaning: &'static str,
    /// The next step.
    pub remedy: &'static str,
}

/// Every code of every group, in the order of the groups.
pub fn all() -> Vec<Explanation> {
    [
        Mode::explanations(),
        Reason::explanations(),
        LedgerStatus::explanations(),
        Verdict::explanations(),
        SnapshotCode::explanations(),
        LinkCode::explanations(),
        CheckCode::explanations(),
        crate::rollout_protocol::Answer::explanations(),
    ]
    .concat()
}

/// A code that does not exist.
#[derive(Debug, thiserror::Error)]
#[error("there is no code '{asked}'; did you mean '{nearest}'? `nearl explain` without a code lists all")]
pub struct UnknownCode {
    asked: String,
    nearest: &'static str,
}

/// The explanation of `code`.
///
/// # Errors
/// [`UnknownCode`] with the nearest one that exists.
pub fn find(code: &str) -> Result<Explanation, UnknownCode> {
    let all = all();
    if let Some(found) = all.iter().find(|e| e.code == code) {
        return Ok(*found);
    }
    let like = |e: &&Explanation| (strsim::jaro_winkler(e.code, code) * 1e6) as u64;
    let nearest = all.iter().max_by_key(like).map_or("none", |e| e.code);
    Err(UnknownCode { asked: code.to_owned(), nearest })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_one_name_a_meaning_and_a_next_step() {
        let all = all();
        for (i, e) in all.iter().enumerate() {
            let is_kebab = e.code.chars().all(|c| c.is_ascii_lowercase() || c == '-');
            assert!(is_kebab && !e.code.is_empty(), "{}", e.code);
            assert!(all[i + 1..].iter().all(|other| other.code != e.code), "'{}' is there twice", e.code);
            for text in [e.meaning, e.remedy] {
                assert!(text.ends_with(['.', '?']) && text.len() > 10, "{}: '{text}'", e.code);
            }
            assert_eq!(find(e.code).unwrap(), *e);
        }
        assert!(all.len() > 50);
    }

    #[test]
    fn an_unknown_code_names_the_nearest() {
        let text = find("stale-sate").unwrap_err().to_string();
        assert!(text.contains("'stale-state'"), "{text}");
    }
}
