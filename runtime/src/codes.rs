//! Every code a program of this workspace prints, with what it means and what to do: the text behind `nearl explain`.
//!
//! A code is declared once, with its enum variant, by [`nearl_controller::codes!`]; [`all`] walks them.

mod tables;

pub use nearl_controller::codes;
pub use nearl_controller::codes::{Explanation, LedgerStatus, SnapshotCode};
pub use tables::{CheckCode, LinkCode};

use crate::link::Verdict;
use crate::rt::{Mode, Reason};

/// Every code of loop, links, snapshots and doctor, in the order of the groups.
pub fn all() -> Vec<Explanation> {
    [
        Mode::explanations(),
        Reason::explanations(),
        LedgerStatus::explanations(),
        Verdict::explanations(),
        SnapshotCode::explanations(),
        LinkCode::explanations(),
        CheckCode::explanations(),
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

/// The explanation of `code` among `all`.
///
/// # Errors
/// [`UnknownCode`] with the nearest one that exists.
pub fn find(all: &[Explanation], code: &str) -> Result<Explanation, UnknownCode> {
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
            assert_eq!(find(&all, e.code).unwrap(), *e);
        }
        assert!(all.len() > 50);
    }

    #[test]
    fn an_unknown_code_names_the_nearest() {
        let text = find(&all(), "stale-sate").unwrap_err().to_string();
        assert!(text.contains("'stale-state'"), "{text}");
    }
}
