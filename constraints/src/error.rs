//! Errors of models and of sets of limits. Each is one sentence: what is wrong, where, by how much, and what to do.

use std::path::PathBuf;

/// A robot file that cannot become a [`Model`](crate::Model).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// The file could not be opened or read.
    #[error("cannot read robot file {path}: {reason}; check the path and its permissions")]
    Unreadable {
        /// File asked for.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// Not XML, or not the kind of XML expected.
    #[error("{file} is not a usable {format} file: {reason}; correct the file")]
    Malformed {
        /// File, or "the text".
        file: String,
        /// "URDF" or "MJCF".
        format: &'static str,
        /// What is wrong and, where known, at which line.
        reason: String,
    },
    /// Pinocchio refused it.
    #[error("{file} was refused by Pinocchio: {reason}; correct the file")]
    Refused {
        /// File, or "the text".
        file: String,
        /// Pinocchio's words.
        reason: String,
    },
    /// Numbers that cannot be: NaN, lower above upper, negative mass; every one is listed.
    #[error("{file} holds impossible numbers: {list}; correct them")]
    Impossible {
        /// File, or "the text".
        file: String,
        /// All of them, joint by joint.
        list: String,
    },
    /// More than a robot has: refused before anything is built from it.
    #[error(
        "{file} has {count} {what}, more than the {most} that are read; leave out what does not belong to the robot"
    )]
    TooLarge {
        /// File, or "the text".
        file: String,
        /// What there is too much of.
        what: &'static str,
        /// How many.
        count: usize,
        /// How many are allowed.
        most: usize,
    },
    /// A name that is not a joint of the model.
    #[error("no joint '{name}' in the model{near}")]
    UnknownJoint {
        /// Name asked for.
        name: String,
        /// "; did you mean ..." or the list of joints.
        near: String,
    },
    /// A name that is not a frame of the model.
    #[error("no frame '{name}' in the model{near}")]
    UnknownFrame {
        /// Name asked for.
        name: String,
        /// "; did you mean ..." or the list of frames.
        near: String,
    },
}

/// A set of limits that cannot become a [`Projector`](crate::Projector).
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LimitError {
    /// A name that is not a joint of the model.
    #[error("{limit} names joint '{name}', which the model does not have{near}")]
    UnknownJoint {
        /// Which limit, as in the task file.
        limit: &'static str,
        /// Name asked for.
        name: String,
        /// "; did you mean ..." or the list of joints.
        near: String,
    },
    /// A name that is not a frame of the model.
    #[error("{limit} names frame '{name}', which the model does not have{near}")]
    UnknownFrame {
        /// Which limit, as in the task file.
        limit: &'static str,
        /// Name asked for.
        name: String,
        /// "; did you mean ..." or the list of frames.
        near: String,
    },
    /// A number out of its domain.
    #[error("{what} is {value}, but must be {}{domain}; change it", if value.is_infinite() && !domain.contains("finite") { "finite and " } else { "" })]
    BadValue {
        /// Setting, with joint where it belongs to one.
        what: String,
        /// Value given.
        value: f64,
        /// What is allowed, with unit.
        domain: &'static str,
    },
    /// The robot file says nothing for controllable joints that the limit needs.
    #[error("{limit} is asked for, but the robot file gives none for {joints}; {next}")]
    Missing {
        /// Which limit.
        limit: &'static str,
        /// Every joint, with what is missing.
        joints: String,
        /// What to do.
        next: &'static str,
    },
    /// Limits that no motion can obey together; every joint is listed.
    #[error("limits contradict each other: {list}; widen one of them")]
    Contradictory {
        /// All of them, joint by joint.
        list: String,
    },
    /// A combination the projector has no meaning for.
    #[error("{what}; {next}")]
    Unusable {
        /// The combination.
        what: String,
        /// What to do.
        next: &'static str,
    },
}

/// "; did you mean 'a' or 'b'?" for the names closest to `name`, else the whole list.
pub(crate) fn near_names<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> String {
    let mut scored: Vec<(f64, &str)> = known.map(|k| (strsim::jaro(name, k), k)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    let close: Vec<String> =
        scored.iter().take(3).filter(|(s, _)| *s > 0.75).map(|(_, k)| format!("'{k}'")).collect();
    if close.is_empty() {
        let all: Vec<&str> = scored.iter().map(|(_, k)| *k).collect();
        return if all.is_empty() {
            "; there is none".into()
        } else {
            format!("; it has {}", all.join(", "))
        };
    }
    format!("; did you mean {}?", close.join(" or "))
}
