//! What is read of a flight log's messages. JSON has no NaN: `null` stands for it.

use serde::{Deserialize, Deserializer};

fn number<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::NAN))
}

fn numbers<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f64>, D::Error> {
    let all = Vec::<Option<f64>>::deserialize(from)?;
    Ok(all.into_iter().map(|x| x.unwrap_or(f64::NAN)).collect())
}

/// A tick in full.
#[derive(Debug, Deserialize)]
pub(crate) struct Tick {
    pub(crate) tick: u64,
    pub(crate) mode: String,
    pub(crate) snapshot: u64,
    pub(crate) swapped: bool,
    pub(crate) sensed: String,
    #[serde(deserialize_with = "number")]
    pub(crate) ramp: f64,
    /// A proposal of another process came in this tick.
    pub(crate) proposed: Option<serde::de::IgnoredAny>,
    pub(crate) proposal_age_ns: Option<u64>,
    pub(crate) state: State,
    #[serde(deserialize_with = "numbers")]
    pub(crate) proposal_q: Vec<f64>,
    #[serde(deserialize_with = "numbers")]
    pub(crate) proposal_v: Vec<f64>,
    #[serde(deserialize_with = "numbers")]
    pub(crate) target_q: Vec<f64>,
    #[serde(deserialize_with = "numbers")]
    pub(crate) target_v: Vec<f64>,
    #[serde(deserialize_with = "numbers")]
    pub(crate) action: Vec<f64>,
    pub(crate) period_tick: u32,
    #[serde(deserialize_with = "numbers")]
    pub(crate) brake: Vec<f64>,
    pub(crate) ledger: Ledger,
}

/// The measured state.
#[derive(Debug, Deserialize)]
pub(crate) struct State {
    #[serde(default)]
    pub(crate) epoch: u64,
    #[serde(default)]
    pub(crate) seq: u64,
    #[serde(default)]
    pub(crate) episode: u64,
    /// How often the plant had no answer in time.
    #[serde(default)]
    pub(crate) late: u64,
    #[serde(default)]
    pub(crate) bits: u32,
    /// The robot's clock [s].
    #[serde(default, deserialize_with = "number")]
    pub(crate) time: f64,
    #[serde(deserialize_with = "numbers")]
    pub(crate) q: Vec<f64>,
    #[serde(deserialize_with = "numbers")]
    pub(crate) v: Vec<f64>,
}

/// What the projection says of itself.
#[derive(Debug, Deserialize)]
pub(crate) struct Ledger {
    pub(crate) status: u32,
    pub(crate) rung: u32,
    /// Active rows, of which the log may have fewer.
    pub(crate) active: usize,
    pub(crate) target_violations: u32,
    /// Limits that the tick began outside.
    pub(crate) outside: u64,
    #[serde(deserialize_with = "number")]
    pub(crate) moved: f64,
    /// The largest share of a limit by which the target exceeds it.
    #[serde(deserialize_with = "number")]
    pub(crate) slack: f64,
    pub(crate) active_rows: Vec<Active>,
}

/// A row that holds the target back.
#[derive(Debug, Deserialize)]
pub(crate) struct Active {
    pub(crate) kind: String,
    pub(crate) row: usize,
    pub(crate) side: String,
    #[serde(deserialize_with = "number")]
    pub(crate) multiplier: f64,
    #[serde(deserialize_with = "number")]
    pub(crate) slack: f64,
}

/// A tick of which only its inputs were kept.
#[derive(Debug, Deserialize)]
pub(crate) struct Brief {
    pub(crate) tick: u64,
}

/// A snapshot by the number that ticks have of it, and which attachment it is.
#[derive(Debug, Deserialize)]
pub(crate) struct Numbered {
    pub(crate) id: u64,
    pub(crate) digest: String,
    #[serde(default)]
    pub(crate) rows: Vec<String>,
}

/// Active rows a tick has room for: with more of them, the log has fewer than were active.
pub const ROOM: usize = 96;
/// Numbers of the statuses `unchanged` and `clamped`.
pub(crate) const UNCHANGED: u32 = 0;
pub(crate) const CLAMPED: u32 = 1;
/// Statuses as the metadata has them.
pub(crate) const STATUSES: [(u32, &str); 14] = [
    (UNCHANGED, "unchanged"),
    (CLAMPED, "clamped"),
    (2, "solved"),
    (3, "recovering"),
    (4, "slowed"),
    (5, "not-projected"),
    (6, "tightening"),
    (7, "actions-bounded"),
    (10, "braked-non-finite-proposal"),
    (11, "braked-no-certified-answer"),
    (12, "braked-non-finite-dynamics"),
    (13, "braked-no-verified-brake"),
    (20, "refused-non-finite-state"),
    (21, "refused-wrong-length"),
];

/// How a projection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Status {
    /// The target is said to be the nearest allowed state.
    Nearest,
    /// Only coming back or braking was allowed.
    Recovering,
    /// No way to stop was found from the nearest: another state.
    Slowed,
    /// Every joint brakes.
    Braked,
    /// Limits were moved, and the robot is on its way to them.
    Tightening,
    /// Nothing was projected.
    NotProjected,
    /// No target is meant to be used.
    Refused,
}

impl Ledger {
    /// The rows of the log are all that were active.
    pub(crate) fn is_whole(&self) -> bool {
        self.active == self.active_rows.len()
    }

    /// The status, if its number is one.
    pub(crate) fn status(&self) -> Option<Status> {
        Some(match self.status {
            0..=2 => Status::Nearest,
            3 => Status::Recovering,
            4 => Status::Slowed,
            5 | 7 => Status::NotProjected,
            6 => Status::Tightening,
            10..=13 => Status::Braked,
            20 | 21 => Status::Refused,
            _ => return None,
        })
    }
}
