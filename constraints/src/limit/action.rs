//! Limits on the action itself, for policies whose actions come out of a network.
//!
//! ```text
//!     least |a - u|^2   with   lower <= a <= upper,   |a_i - a_i before| <= rate_i,
//!                              sum |v_i a_i| <= power,   sum max(v_i a_i, 0) <= delivered,   sum a_i^2 <= square
//! ```
//!
//! `u` is what the policy asks for, `v_i` the velocity of the joint that entry `i` drives. Each sum has one term an entry, so that with a
//! multiplier for each sum every entry is found for itself,
//!
//! ```text
//!     a_i = clamp(shrink(u_i) / (1 + 2 m_square)),   shrink towards 0 by   m_power |v_i| + m_delivered max(+-v_i, 0)
//! ```
//!
//! and a sum falls where its multiplier grows: bisection ends between two neighbouring floating-point numbers, on the side that obeys.

use super::PerJoint;
use crate::description::Motor;
use crate::{LimitError, Model, Recent};
use serde::{Deserialize, Serialize};

/// `action = { power, delivered, square, rate }`; at least one of them.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActionSettings {
    /// Largest `sum |v_i a_i|` [rad/s or m/s, times the unit of the action].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub power: Option<f64>,
    /// Largest `sum max(v_i a_i, 0)` [as `power`]: what is put into the joints, without what is taken out of others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub delivered: Option<f64>,
    /// Largest `sum a_i^2` [unit of the action, squared].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub square: Option<f64>,
    /// Largest change from one control period to the next, by joint [unit of the action].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate: Option<PerJoint>,
}

/// A sum over the entries of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sum {
    Power,
    Delivered,
    Square,
}

impl Sum {
    fn term(self, v: f64, a: f64) -> f64 {
        match self {
            Sum::Power => (v * a).abs(),
            Sum::Delivered => (v * a).max(0.0),
            Sum::Square => a * a,
        }
    }
}

/// What became of an action.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ActionReport {
    /// Distance from the action within the actuators' range to the one that is given [unit of the action]; Euclidean for [`ActionLimit`].
    pub moved: f64,
    /// Limits that the action broke before; for [`ActionLimit`] each sum is one, and all rates are one.
    pub raw_violations: u32,
    /// Limits that the given one breaks by more than 1e-9, counted from the formulas and not from how it was found.
    pub target_violations: u32,
}

/// Keeps an action within [`ActionSettings`]. Nothing is allocated after [`ActionLimit::new`].
#[derive(Debug, Clone)]
pub struct ActionLimit {
    sums: Vec<(Sum, f64)>,
    /// By action entry; infinite where there is none.
    rate: Vec<f64>,
    range: Vec<(f64, f64)>,
    /// Dof that an entry drives.
    dofs: Vec<usize>,
    /// The last actions that were given.
    given: Recent,
    /// Of the call under way: what is asked for, velocities, bounds, and the answer.
    asked: Vec<f64>,
    v: Vec<f64>,
    bounds: Vec<(f64, f64)>,
    answer: Vec<f64>,
    multiplier: Vec<f64>,
}

/// A larger multiplier moves nothing any more.
const MOST: f64 = 1e18;
/// More than this beyond a limit is a violation.
const TOLERANCE: f64 = 1e-9;

impl ActionLimit {
    /// For the actions of `model`'s motors, or, where there are fewer, of those of the joints of `controllable` in the motors' order; `range` are their
    /// lowest and highest values (n_act).
    ///
    /// # Errors
    /// [`LimitError`] for a number that is none, an entry that drives no joint alone, and limits that may leave no action.
    pub fn new(
        settings: &ActionSettings,
        model: &Model,
        controllable: &[usize],
        range: Vec<(f64, f64)>,
    ) -> Result<ActionLimit, LimitError> {
        let unusable = |what: String, next: &'static str| Err(LimitError::Unusable { what, next });
        let all = [
            ("action.power", Sum::Power, settings.power),
            ("action.delivered", Sum::Delivered, settings.delivered),
            ("action.square", Sum::Square, settings.square),
        ];
        let mut sums = Vec::new();
        for (name, sum, limit) in all.into_iter().filter_map(|(n, s, l)| Some((n, s, l?))) {
            if !(limit.is_finite() && limit > 0.0) {
                let domain = "above 0";
                return Err(LimitError::BadValue { what: name.into(), value: limit, domain });
            }
            sums.push((sum, limit));
        }
        if sums.is_empty() && settings.rate.is_none() {
            return unusable("action limits nothing".into(), "give power, delivered, square or rate");
        }
        if let Some(i) = range.iter().position(|r| !(r.0 <= 0.0 && 0.0 <= r.1)).filter(|_| !sums.is_empty()) {
            let what = format!("action entry {i} cannot be 0, so a sum over actions may leave nothing");
            return unusable(what, "leave power, delivered and square out");
        }
        if settings.rate.is_some() && sums.iter().any(|(sum, _)| *sum != Sum::Square) {
            let what = "action.rate beside power or delivered may leave nothing when a joint becomes faster";
            return unusable(what.into(), "keep one of them");
        }
        let dofs = driven(model, range.len(), controllable)?;
        let rate = match &settings.rate {
            None => vec![f64::INFINITY; range.len()],
            Some(rate) => {
                let values = rate.values(model, "action.rate", |x| x > 0.0, "above 0")?;
                dofs.iter().map(|&dof| values[dof].unwrap_or(f64::INFINITY)).collect()
            }
        };
        let (n, zero) = (range.len(), vec![0.0; range.len()]);
        let (asked, v, answer, multiplier) = (zero.clone(), zero.clone(), zero, vec![0.0; sums.len()]);
        Ok(ActionLimit {
            sums,
            rate,
            bounds: vec![(0.0, 0.0); n],
            range,
            dofs,
            given: Recent::new(n),
            asked,
            v,
            answer,
            multiplier,
        })
    }

    /// Replaces `action` (n_act) by the nearest one that every limit allows at velocity `v` (nv). With `hold` off it stays as it is, and what it
    /// breaks is counted.
    pub fn project(&mut self, v: &[f64], action: &mut [f64], hold: bool) -> ActionReport {
        self.asked.copy_from_slice(action);
        for (own, &dof) in self.v.iter_mut().zip(&self.dofs) {
            *own = v[dof];
        }
        for i in 0..action.len() {
            let (lower, upper) = self.range[i];
            self.bounds[i] = if let Some(given) = self.given.get() {
                let at = given[i].clamp(lower, upper);
                ((at - self.rate[i]).max(lower), (at + self.rate[i]).min(upper))
            } else {
                (lower, upper)
            };
        }
        let raw_violations = self.broken(action);
        if hold {
            self.fit(self.sums.len());
            action.copy_from_slice(&self.answer);
        }
        let target_violations = self.broken(action);
        let square = |(a, u): (&f64, &f64)| (a - u) * (a - u);
        let moved = action.iter().zip(&self.asked).map(square).sum::<f64>().sqrt();
        if self.remembers() {
            self.given.push(&*action);
        }
        ActionReport { moved, raw_violations, target_violations }
    }

    /// Finds the multipliers of the first `k` sums with those of the others given, and the action.
    fn fit(&mut self, k: usize) {
        let Some(at) = k.checked_sub(1) else { return self.answer() };
        self.multiplier[at] = 0.0;
        self.fit(at);
        if self.obeys(at) {
            return;
        }
        let (mut low, mut high) = (0.0, 1.0);
        loop {
            self.multiplier[at] = high;
            self.fit(at);
            if self.obeys(at) || high >= MOST {
                break;
            }
            (low, high) = (high, 4.0 * high);
        }
        loop {
            let middle = 0.5 * (low + high);
            if middle <= low || middle >= high {
                break;
            }
            self.multiplier[at] = middle;
            self.fit(at);
            if self.obeys(at) { high = middle } else { low = middle }
        }
        self.multiplier[at] = high;
        self.fit(at);
    }

    /// The action for the present multipliers, entry by entry.
    fn answer(&mut self) {
        let mut m = [0.0; 3];
        for ((sum, _), x) in self.sums.iter().zip(&self.multiplier) {
            m[*sum as usize] = *x;
        }
        let [power, delivered, square] = m;
        for i in 0..self.answer.len() {
            let (u, v, (lower, upper)) = (self.asked[i], self.v[i], self.bounds[i]);
            let up = power * v.abs() + delivered * v.max(0.0);
            let down = power * v.abs() + delivered * (-v).max(0.0);
            let free = if u > up {
                u - up
            } else if u < -down {
                u + down
            } else {
                0.0
            };
            self.answer[i] = (free / (1.0 + 2.0 * square)).clamp(lower, upper);
        }
    }

    fn value(&self, sum: Sum, action: &[f64]) -> f64 {
        self.v.iter().zip(action).map(|(v, a)| sum.term(*v, *a)).sum()
    }

    fn obeys(&self, at: usize) -> bool {
        let (sum, limit) = self.sums[at];
        self.value(sum, &self.answer) <= limit
    }

    fn broken(&self, action: &[f64]) -> u32 {
        let sums = self.sums.iter().filter(|(sum, limit)| self.value(*sum, action) > limit + TOLERANCE);
        let changes = self.given.get().is_some_and(|given| {
            let change = action.iter().zip(given).map(|(a, b)| (a - b).abs());
            change.zip(&self.rate).any(|(change, rate)| change > rate + TOLERANCE)
        });
        sums.count() as u32 + u32::from(changes)
    }

    /// Whether an action depends on the one before.
    pub fn remembers(&self) -> bool {
        self.rate.iter().any(|rate| rate.is_finite())
    }

    /// Begins anew: no rate holds for the next action.
    pub fn forget(&mut self) {
        self.given.forget();
    }

    /// The action before came too late and was never sent: the next one follows on the one before that.
    pub fn recall(&mut self) {
        self.given.recall();
    }

    /// Entries of its memory.
    pub fn memory_len(&self) -> usize {
        if self.remembers() { self.given.memory_len() } else { 0 }
    }

    /// Appends what the next action depends on beside its arguments.
    pub fn write_memory(&self, memory: &mut Vec<f64>) {
        if self.remembers() {
            self.given.write(memory);
        }
    }

    /// Takes what [`ActionLimit::write_memory`] gave.
    ///
    /// # Panics
    /// When it has another length.
    pub fn set_memory(&mut self, memory: &[f64]) {
        assert_eq!(memory.len(), self.memory_len(), "memory of another limit");
        if self.remembers() {
            self.given.read(memory);
        }
    }
}

/// The dof that each of `n` action entries drives: of all motors, or, where fewer are commanded, of those of the joints of `controllable`, in their order.
fn driven(model: &Model, n: usize, controllable: &[usize]) -> Result<Vec<usize>, LimitError> {
    let is_commanded = |motor: &&Motor| {
        let joint = model.find(&motor.joint).ok();
        joint.is_some_and(|joint| joint.nv == 1 && controllable.contains(&joint.idx_v))
    };
    let mut commanded: Vec<&Motor> = model.motors().iter().filter(is_commanded).collect();
    commanded.sort_by_key(|motor| motor.order);
    let all = n >= model.motors().len();
    (0..n)
        .map(|i| {
            let motor = match all {
                true => model.motors().iter().find(|m| m.order == i),
                false => commanded.get(i).copied().filter(|_| commanded.len() == n),
            };
            let joint = motor.map(|m| m.joint.as_str());
            let joint = joint.and_then(|name| model.find(name).ok()).filter(|joint| joint.nv == 1);
            joint.map(|joint| joint.idx_v).ok_or_else(|| LimitError::Unusable {
                what: format!("action entry {i} drives no joint of one dof that the robot file names"),
                next: "leave action out, or drive one joint with each entry",
            })
        })
        .collect()
}
