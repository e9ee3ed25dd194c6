//! Every code a program of this workspace prints, with what it means and what to do: the text behind `nearl explain`.
//!
//! A code is declared once, with its enum variant, by [`nearl_controller::codes!`]; [`all`] walks them.

mod tables;

pub use nearl_controller::codes;
pub use nearl_controller::codes::{Explanation, LedgerStatus, SnapshotCode};
pub use tables::{CheckCode, LinkCode};

use crate::link::Verdict;
use crate::rt::{Mode, Reason};

/// Every code of loop, links, snapshots and doctor, in the order of the groups. A reason that is the name of a tick's status, several
/// times in a row, is explained by that status.
pub fn all() -> Vec<Explanation> {
    let statuses = LedgerStatus::explanations();
    let is_reason_alone = |reason: &Explanation| statuses.iter().all(|status| status.code != reason.code);
    [
        Mode::explanations(),
        Reason::explanations().into_iter().filter(is_reason_alone).collect(),
        statuses.clone(),
        Verdict::explanations(),
        SnapshotCode::explanations(),
        LinkCode::explanations(),
        CheckCode::explanations(),
    ]
    .concat()
}

/// A code that does not exist.
#[derive(Debug, thiserror::Error)]
#[error("there is no code '{asked}'; did you mean {nearest}? `nearl explain` without a code lists all")]
pub struct UnknownCode {
    asked: String,
    /// The nearest one, or all that have what was asked for as a word.
    nearest: String,
}

/// The explanation of `code` among `all`.
///
/// # Errors
/// [`UnknownCode`] with the nearest one that exists.
pub fn find(all: &[Explanation], code: &str) -> Result<Explanation, UnknownCode> {
    let asked = code.to_lowercase();
    if let Some(found) = all.iter().find(|e| e.code == asked) {
        return Ok(*found);
    }
    let of_it = all.iter().filter(|e| format!("-{}-", e.code).contains(&format!("-{asked}-")));
    let of_it: Vec<String> = of_it.map(|e| format!("'{}'", e.code)).collect();
    let like = |e: &&Explanation| (strsim::jaro(e.code, &asked) * 1e6) as u64;
    let nearest = || all.iter().max_by_key(like).map_or("none".into(), |e| format!("'{}'", e.code));
    let nearest = if of_it.is_empty() { nearest() } else { of_it.join(", ") };
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

    /// What made a tick brake has one name, in the tick's status and as the reason of the mode it led to.
    #[test]
    fn the_reason_of_a_mode_has_the_name_of_the_status_behind_it() {
        let braked = LedgerStatus::ALL.iter().filter(|status| status.name().starts_with("braked-"));
        for status in braked {
            assert!(Reason::ALL.iter().any(|reason| reason.name() == status.name()), "{status}");
        }
    }

    #[test]
    fn an_unknown_code_names_the_nearest() {
        let text = find(&all(), "stale-sate").unwrap_err().to_string();
        assert!(text.contains("'stale-state'"), "{text}");
        let text = find(&all(), "Implausible").unwrap_err().to_string();
        assert!(text.contains("'implausible-state'"), "{text}");
        assert_eq!(find(&all(), "Degraded").unwrap().code, "degraded");
        let text = find(&all(), "braked").unwrap_err().to_string();
        assert!(
            text.contains("'braked-no-verified-brake'") && text.contains("'braked-non-finite-proposal'"),
            "{text}"
        );
    }
}
