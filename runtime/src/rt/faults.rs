//! A fault plan rehearses failures: a seeded list of (cycle, fault, arguments), written into the flight log so that it replays.
//!
//! `nearl plant --faults FILE` and `nearl run --faults FILE` play the same file: the plant takes the faults of its
//! sensors, the loop those of the policy and of time.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::link::{ActionMessage, Plant, StateMessage, TallyMessage};

/// What is to go wrong, and when.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultPlan {
    /// Seed of the joints that faults hit where they name none.
    #[serde(default)]
    pub seed: u64,
    /// The faults; several may overlap.
    #[serde(default)]
    pub faults: Vec<Fault>,
}

/// One fault: from `tick` on, for `count` ticks (of the plant for sensor faults, of the loop for the others).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// First tick, from 1.
    pub tick: u64,
    /// Number of ticks.
    #[serde(default = "one")]
    pub count: u64,
    /// What goes wrong.
    pub kind: FaultKind,
}

fn one() -> u64 {
    1
}

/// A number that should not be where it is put.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Odd {
    /// Not a number.
    Nan,
    /// Infinity.
    Infinity,
    /// 1e300, or the largest single-precision number.
    Huge,
    /// 1e-310, or the smallest single-precision number.
    Denormal,
}

impl Odd {
    /// As a double.
    pub fn value(self) -> f64 {
        match self {
            Odd::Nan => f64::NAN,
            Odd::Infinity => f64::INFINITY,
            Odd::Huge => 1e300,
            Odd::Denormal => 1e-310,
        }
    }

    /// As a single.
    pub fn single(self) -> f32 {
        match self {
            Odd::Nan => f32::NAN,
            Odd::Infinity => f32::INFINITY,
            Odd::Huge => f32::MAX,
            Odd::Denormal => f32::from_bits(1),
        }
    }
}

/// Kinds of faults.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "fault", rename_all = "kebab-case", deny_unknown_fields)]
pub enum FaultKind {
    /// A measured velocity is an odd number.
    State {
        /// The number.
        number: Odd,
    },
    /// A measured position is off by so much [rad or m].
    Jump {
        /// Offset.
        by: f64,
    },
    /// The plant measures its old state again.
    Freeze,
    /// The plant's clock goes back.
    Back {
        /// By so much in every tick \[s\].
        by: f64,
    },
    /// A state is lost on the way.
    Drop,
    /// A state comes twice.
    Duplicate,
    /// A state comes after the next one.
    Reorder,
    /// A state is so old when it comes \[s\].
    Late {
        /// Age.
        age: f64,
    },
    /// The policy's noise, and with it a stochastic policy's proposal, is an odd number.
    Proposal {
        /// The number.
        number: Odd,
    },
    /// The controller panics.
    Panic,
    /// The tick takes so many periods.
    Overrun {
        /// Duration in periods.
        periods: f64,
    },
}

impl FaultKind {
    /// Between plant and loop: the tests play these, on messages of their own.
    fn is_of_the_way(self) -> bool {
        matches!(self, FaultKind::Drop | FaultKind::Duplicate | FaultKind::Reorder | FaultKind::Late { .. })
    }
}

/// Why a plan cannot be played.
#[derive(Debug, thiserror::Error)]
#[error(
    "fault plan '{file}' cannot be used ({reason}): write {{\"faults\": [{{\"tick\": 100, \"kind\": {{\"fault\": \"freeze\"}}}}]}}"
)]
pub struct FaultPlanError {
    file: String,
    reason: String,
}

impl FaultPlan {
    /// Reads a JSON file of faults that `nearl plant` or `nearl run` plays.
    ///
    /// # Errors
    /// One sentence with the file, also for a fault of the way between the two.
    pub fn load(path: &Path) -> Result<FaultPlan, FaultPlanError> {
        let fail = |reason: String| FaultPlanError { file: path.display().to_string(), reason };
        let text = nearl_constraints::read_text(path).map_err(|e| fail(e.to_string()))?;
        let plan: FaultPlan = serde_json::from_str(&text).map_err(|e| fail(crate::snapshot::one_line(&e)))?;
        match plan.faults.iter().position(|f| f.kind.is_of_the_way()) {
            Some(i) => Err(fail(format!(
                "fault {} of the list happens between plant and loop, where no command plays one; take it out",
                i + 1
            ))),
            None => Ok(plan),
        }
    }

    /// The faults of `tick` (from 1) with their number in the list.
    pub fn at(&self, tick: u64) -> impl Iterator<Item = (usize, FaultKind)> {
        let is_now = move |f: &Fault| tick >= f.tick && tick - f.tick < f.count;
        self.faults.iter().enumerate().filter(move |(_, f)| is_now(f)).map(|(i, f)| (i, f.kind))
    }

    /// A number below `n` for fault number `index`, by the seed: the joint it hits, or the moment it comes.
    pub fn draw(&self, index: usize, n: usize) -> usize {
        let mixed = (self.seed ^ (index as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15))
            .wrapping_mul(0xbf58_476d_1ce4_e5b9);
        ((mixed >> 33) as usize).checked_rem(n).unwrap_or(0)
    }

    /// Noise of the proposal in `tick`.
    pub(crate) fn noise(&self, tick: u64) -> f32 {
        let noise =
            |kind| if let FaultKind::Proposal { number } = kind { Some(number.single()) } else { None };
        self.at(tick).find_map(|(_, kind)| noise(kind)).unwrap_or(0.0)
    }

    /// Whether the controller panics in `tick`.
    pub(crate) fn panics(&self, tick: u64) -> bool {
        self.at(tick).any(|(_, kind)| kind == FaultKind::Panic)
    }

    /// Periods that `tick` takes at least.
    pub(crate) fn periods(&self, tick: u64) -> f64 {
        let periods = |kind| if let FaultKind::Overrun { periods } = kind { Some(periods) } else { None };
        self.at(tick).filter_map(|(_, kind)| periods(kind)).fold(0.0, f64::max)
    }

    /// Plays the faults of the plant's sensors on the state of `tick`; `last` is the one measured before.
    pub fn spoil(&self, tick: u64, state: &mut StateMessage, last: &StateMessage) {
        for (index, kind) in self.at(tick) {
            let joint = self.draw(index, state.v().len().min(state.q().len()));
            match kind {
                FaultKind::State { number } => state.v[joint] = number.value(),
                FaultKind::Jump { by } => state.q[joint] += by,
                FaultKind::Back { by } => state.time = last.time - by,
                FaultKind::Freeze => {
                    (state.q, state.v, state.obs, state.time) = (last.q, last.v, last.obs, last.time);
                }
                _ => {}
            }
        }
    }
}

/// A plant whose sensors fail as planned.
pub struct FaultyPlant<P> {
    /// The plant behind.
    pub plant: P,
    plan: FaultPlan,
    tick: u64,
    last: StateMessage,
}

impl<P: Plant> FaultyPlant<P> {
    /// Plays `plan` on what `plant` measures.
    pub fn new(plant: P, plan: FaultPlan) -> FaultyPlant<P> {
        FaultyPlant { plant, plan, tick: 0, last: crate::link::Message::zeroed() }
    }
}

impl<P: Plant> Plant for FaultyPlant<P> {
    fn observe(&mut self, state: &mut StateMessage) {
        self.plant.observe(state);
        self.tick += 1;
        self.plan.spoil(self.tick, state, &self.last);
        self.last = *state;
    }
    fn apply(&mut self, action: &ActionMessage) {
        self.plant.apply(action);
    }
    fn hold(&mut self, action: &ActionMessage) {
        self.plant.hold(action);
    }
    fn brake(&mut self) {
        self.plant.brake();
    }
    fn tally(&self, tally: &mut TallyMessage) {
        self.plant.tally(tally);
    }
}
