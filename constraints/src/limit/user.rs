//! Linear rows of the task file's own, by state names.

use super::margin::is_zero;
use super::{About, Argument, Form, Limit, Takes};
use crate::row::{Motion, Needs, Rows, RowsMut, TickStart};
use crate::viability::{POSITION_TOLERANCE, Period, approach};
use crate::{Kind, LimitError, LimitSet, Model, Soft};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What it says of itself.
pub(super) const ABOUT: About = About {
    class: "RowLimit",
    promise: "A linear row over `q.`, `v.` and `a.` of joints of the next state: `lower`, `upper` or `equals`. With \
        `braking` a sum of positions stops in front of its bounds.",
    example: "rows = [{ name = \"elbow up\", terms = { \"q.panda_joint4\" = 1.0 }, upper = -0.5, braking = 2.0 }]",
    form: Form::Either,
    margin: "from `lower` and `upper`, in the unit of the sum; not with `equals`",
    stricter: Some([
        "rows = [{ name = \"r\", terms = { \"q.panda_joint4\" = 1.0 }, braking = 2.0, upper = -0.5, lower = -2.8, \
        margin = 0.9 }]",
        "rows = [{ name = \"r\", terms = { \"q.panda_joint4\" = 1.0 }, braking = 2.0, upper = -1.4, lower = -1.9 }]",
    ]),
    arguments: &[
        Argument::needed("name", Takes::Text),
        Argument::needed("terms", Takes::Numbers),
        Argument::named("lower", Takes::Number, "None"),
        Argument::named("upper", Takes::Number, "None"),
        Argument::named("equals", Takes::Number, "None"),
        Argument::named("braking", Takes::Number, "None"),
        Argument::SOFT,
        Argument::MARGIN,
    ],
};

/// `rows = [{ name, terms = { "q.joint" = 1.0, "v.joint" = -0.5 }, lower, upper, equals, braking, margin, soft }]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UserRowSettings {
    /// Name in reports, and to switch it on and off by.
    pub name: String,
    /// Coefficients of the next state: `q.<joint>` [rad or m], `v.<joint>` [per s], `a.<joint>` (acceleration) [per s²].
    pub terms: BTreeMap<String, f64>,
    /// Lowest value of the sum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lower: Option<f64>,
    /// Highest value of the sum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub upper: Option<f64>,
    /// The only value of the sum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub equals: Option<f64>,
    /// For sums of positions: the deceleration of the sum that may be counted on, so that it stops in front of a bound.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub braking: Option<f64>,
    /// Distance of the sum kept from its bounds.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub margin: f64,
    /// How much it resists; hard when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub soft: Option<Soft>,
}

/// `lower <= sum of terms of the next state <= upper`.
///
/// With `braking` B the sum `s` of positions is held like a joint: its acceleration toward a bound is at most what
/// [`approach`] gives for its distance and speed; of a B that its joints together do not give, what they give counts. Without it
/// the row speaks of the next state alone, and nothing looks ahead.
///
/// A hard row with `equals` stays at that value. A sum of positions at it, `s = e`, is held by its acceleration alone,
///
/// ```text
///     s'' = -(w + r (s - e)) / T,   r = min(1 / (2 T), RETURN)
/// ```
///
/// which takes off what rounding leaves; over several physics steps, which lead elsewhere, it is at `e` within `B T^2 / 4`, with
/// `r = 1 / (2 T)`. Beside it, `e` is a lower and an upper bound with a `braking` of what each of its joints alone can
/// give: the sum stops there if the proposal leads it there. A sum without accelerations that is beside its value goes no further from it. Brakes slow
/// the joints of such a row down in proportion, which leaves the sum of positions, and sums of speeds or accelerations that are 0, where
/// they are.
#[derive(Debug, Clone)]
pub struct UserRow {
    settings: UserRowSettings,
}

/// Coefficients beyond this are no unit's; their squares leave the range of the solver.
const LARGEST: f64 = 1e12;
/// No joint decelerates faster [rad/s² or m/s²].
const QUICKEST: f64 = 1e6;

impl UserRow {
    /// From the task file's settings.
    pub fn new(settings: UserRowSettings) -> UserRow {
        UserRow { settings }
    }

    fn term(&self, model: &Model, name: &str, coefficient: f64) -> Result<Term, LimitError> {
        let unusable = |why: &str| LimitError::Unusable {
            what: format!("row '{}' names '{name}', {why}", self.settings.name),
            next: "write q.<joint>, v.<joint> or a.<joint>",
        };
        let (letter, joint) = name.split_once('.').ok_or_else(|| unusable("which is no state"))?;
        let quantity = match letter {
            "q" => Quantity::Position,
            "v" => Quantity::Velocity,
            "a" => Quantity::Acceleration,
            _ => return Err(unusable("which is no state")),
        };
        let unknown = |near| LimitError::UnknownJoint { limit: "rows", name: joint.to_string(), near };
        let joint = model.find(joint).map_err(unknown)?;
        if joint.nv != 1 {
            return Err(unusable("a joint with several dofs"));
        }
        if joint.nq != 1 && quantity == Quantity::Position {
            return Err(unusable("a continuous joint, whose position is (cos, sin) and no angle"));
        }
        let sane = coefficient.abs() <= LARGEST; // NaN is not
        if !sane || coefficient == 0.0 {
            let what = format!("coefficient of '{name}' in row '{}'", self.settings.name);
            let domain = "a number but 0, and at most 1e12 in size";
            return Err(LimitError::BadValue { what, value: coefficient, domain });
        }
        Ok(Term { quantity, dof: joint.idx_v, idx_q: joint.idx_q, coefficient })
    }

    /// Lower and upper bound.
    fn bounds(&self) -> Result<(f64, f64), LimitError> {
        let s = &self.settings;
        let bad = |what: &str, value, domain| {
            Err(LimitError::BadValue { what: format!("{what} of row '{}'", s.name), value, domain })
        };
        for (what, value) in [("lower", s.lower), ("upper", s.upper), ("equals", s.equals)] {
            if let Some(value) = value.filter(|x| !x.is_finite()) {
                return bad(what, value, "a finite number");
            }
        }
        let steepest = s.terms.values().fold(0.0, |most: f64, c| most.max(c.abs()));
        if let Some(value) = s.braking.filter(|b| !(*b > 0.0 && *b <= QUICKEST * steepest)) {
            return bad(
                "braking",
                value,
                "above 0, and at most a million times the largest coefficient, in the unit of the sum per s²",
            );
        }
        if !(s.margin >= 0.0 && s.margin.is_finite()) {
            return bad("margin", s.margin, "at least 0, in the unit of the sum");
        }
        let (lower, upper) = (s.lower.map(|x| x + s.margin), s.upper.map(|x| x - s.margin));
        match (lower, upper, s.equals) {
            (None, None, Some(_)) if s.margin > 0.0 => Err(LimitError::Unusable {
                what: format!("row '{}' has equals and a margin, which leave nothing", s.name),
                next: "drop the margin, or give lower and upper",
            }),
            (None, None, Some(x)) => Ok((x, x)),
            (None, None, None) | (Some(_), _, Some(_)) | (_, Some(_), Some(_)) => Err(LimitError::Unusable {
                what: format!("row '{}' needs equals, or lower or upper or both", s.name),
                next: "give one of them",
            }),
            (Some(low), Some(high), _) if low >= high => Err(LimitError::Contradictory {
                list: format!("row '{}' would have to stay above {low} and below {high}", s.name),
            }),
            (low, high, _) => Ok((low.unwrap_or(f64::NEG_INFINITY), high.unwrap_or(f64::INFINITY))),
        }
    }
}

impl Limit for UserRow {
    fn name(&self) -> &'static str {
        "rows"
    }

    fn label(&self) -> &str {
        &self.settings.name
    }

    fn rows(&self, model: &Model, controllable: &[usize]) -> Result<Option<Box<dyn Rows>>, LimitError> {
        let s = &self.settings;
        if s.terms.is_empty() {
            let what = format!("row '{}' has no terms", s.name);
            return Err(LimitError::Unusable {
                what,
                next: "give some, as { \"v.JOINT\" = 1.0 }, or drop the row",
            });
        }
        let terms: Vec<Term> =
            s.terms.iter().map(|(name, c)| self.term(model, name, *c)).collect::<Result<_, _>>()?;
        let bounds = self.bounds()?;
        if !controllable.is_empty() && !terms.iter().any(|t| controllable.contains(&t.dof)) {
            return Err(LimitError::Unusable {
                what: format!("row '{}' holds no controllable joint", s.name),
                next: "name one, or drop the row",
            });
        }
        let (equality, of_positions) =
            (s.equals.is_some(), terms.iter().all(|t| t.quantity == Quantity::Position));
        if s.braking.is_some() && !of_positions {
            return Err(LimitError::Unusable {
                what: format!("row '{}' has braking but not only positions", s.name),
                next: "brake on q.<joint> alone, or drop braking",
            });
        }
        if s.braking.is_none() && s.soft.is_none() && of_positions && !equality {
            return Err(LimitError::Unusable {
                what: format!(
                    "row '{}' bounds positions but has no braking, so that nothing stops in front of it",
                    s.name
                ),
                next: "give braking, the deceleration of the sum to count on, or soft",
            });
        }
        let largest =
            [bounds.0, bounds.1].into_iter().filter(|x| x.is_finite()).fold(0.0, |m: f64, x| m.max(x.abs()));
        let steepest = terms.iter().fold(0.0, |m: f64, t| m.max(t.coefficient.abs()));
        let size = match s.braking {
            Some(braking) => braking,
            None if largest > 0.0 => largest,
            None => steepest,
        };
        let hard = s.soft.is_none();
        let has = |quantity| terms.iter().any(|t| t.quantity == quantity);
        let equal = match (has(Quantity::Position), has(Quantity::Velocity), has(Quantity::Acceleration)) {
            _ if !(equality && hard) => None,
            (true, false, false) => Some(Equal::Positions),
            (_, _, false) => Some(Equal::Speeds),
            _ => Some(Equal::Accelerations),
        };
        // A brake in proportion keeps any sum of positions, and a sum of speeds or of accelerations at 0.
        let one = terms.iter().all(|t| t.quantity == terms[0].quantity);
        let moved = terms.iter().all(|t| controllable.is_empty() || controllable.contains(&t.dof));
        let kept = equal.is_some() && moved && one && (of_positions || bounds.0 == 0.0);
        let (name, braking) = (s.name.clone(), s.braking);
        Ok(Some(Box::new(Row { name, terms, bounds, braking, size, equality, hard, equal, kept, steepest })))
    }

    fn notes(&self, _: &Model, _: &[usize]) -> Vec<String> {
        let s = &self.settings;
        let moves = s.soft.is_none() && !s.terms.keys().any(|name| name.starts_with("q."));
        let Ok((low, high)) = self.bounds() else { return Vec::new() }; // refused where the rows are made
        if !moves || (low <= 0.0 && high >= 0.0) {
            return Vec::new();
        }
        vec![format!(
            "row '{}' does not let its joints stand still ({low} to {high} leaves 0 out): no brake keeps it, and a robot at rest only brakes; let 0 in, or \
             make the row soft",
            s.name
        )]
    }

    fn soft(&self) -> Option<Soft> {
        self.settings.soft
    }
}

#[derive(Clone, Copy, PartialEq)]
enum Quantity {
    Position,
    Velocity,
    Acceleration,
}

struct Term {
    quantity: Quantity,
    dof: usize,
    idx_q: usize,
    coefficient: f64,
}

/// What a hard row with `equals` is a sum of.
#[derive(Clone, Copy, PartialEq)]
enum Equal {
    /// Positions alone.
    Positions,
    /// Speeds, perhaps with positions.
    Speeds,
    /// Accelerations, perhaps with others.
    Accelerations,
}

struct Row {
    name: String,
    terms: Vec<Term>,
    bounds: (f64, f64),
    braking: Option<f64>,
    size: f64,
    equality: bool,
    hard: bool,
    equal: Option<Equal>,
    /// A brake in proportion keeps its value.
    kept: bool,
    /// The largest coefficient.
    steepest: f64,
}

/// A sum of positions that is this far from its value, or would be after a period, is at it [unit of the sum].
const AT: f64 = 1e-9;

/// The same for a sum of speeds, as a share of its size.
const AT_SPEED: f64 = 2e-9;

/// The same of positions over several physics steps, as a share of `B T^2`.
const OVER_STEPS: f64 = 0.25;

/// Rate at which what rounding leaves of a distance is taken off [1/s].
const RETURN: f64 = 2.0;

impl Row {
    /// The sum of positions and its speed.
    fn sum(&self, q: &[f64], v: &[f64]) -> (f64, f64) {
        let each = |x: &dyn Fn(&Term) -> f64| self.terms.iter().map(|t| t.coefficient * x(t)).sum();
        (each(&|t| q[t.idx_q]), each(&|t| v[t.dof]))
    }

    /// The sum of a state, or of a motion where `a` is given.
    fn value(&self, q: &[f64], v: &[f64], a: Option<&[f64]>) -> f64 {
        let each = |t: &Term| match t.quantity {
            Quantity::Position => q[t.idx_q],
            Quantity::Velocity => v[t.dof],
            Quantity::Acceleration => a.map_or(0.0, |a| a[t.dof]),
        };
        self.terms.iter().map(|t| t.coefficient * each(t)).sum()
    }

    /// How far from its value a sum of positions is at it, and the rate at which what is left of that is taken off [1/s]. Several physics steps lead a joint
    /// elsewhere in each period: where `braking` takes that off within a few periods, the sum is at its value.
    fn keeping(&self, period: &Period) -> (f64, f64) {
        let (t, fastest) = (period.dt, 0.5 / period.dt);
        match self.braking.filter(|_| period.sub_steps > 1) {
            Some(braking) => (AT.max(OVER_STEPS * braking * t * t), fastest),
            None => (AT, RETURN.min(fastest)),
        }
    }

    /// Whether a sum of positions with that speed is at the value it is kept at.
    fn is_at(&self, (s, w): (f64, f64), period: &Period) -> bool {
        let (at, _) = self.keeping(period);
        (s - self.bounds.0).abs() <= at && (w * period.dt).abs() <= at
    }

    /// The lowest and highest sum that the limits of single joints leave.
    fn reach(&self, limits: &LimitSet) -> (f64, f64) {
        self.terms.iter().fold((0.0, 0.0), |(low, high), t| {
            let (from, to) = match t.quantity {
                Quantity::Position => (limits.q_lower[t.dof], limits.q_upper[t.dof]),
                Quantity::Velocity => (-limits.velocity[t.dof], limits.velocity[t.dof]),
                Quantity::Acceleration => (-limits.acceleration[t.dof], limits.acceleration[t.dof]),
            };
            let ends = [t.coefficient * from, t.coefficient * to];
            (low + ends[0].min(ends[1]), high + ends[0].max(ends[1]))
        })
    }

    /// Rows of a sum of positions in the unit of its acceleration.
    fn fill_braking(&self, braking: f64, tick: &TickStart<'_>, rows: &mut RowsMut<'_>) {
        let t = tick.period.dt;
        let (s, w) = self.sum(tick.q, tick.v);
        for term in &self.terms {
            rows.row(0)[term.dof] += term.coefficient / t;
        }
        if self.equal.is_some() && self.is_at((s, w), tick.period) {
            let held = -(w + self.keeping(tick.period).1 * (s - self.bounds.0)) / t;
            (rows.lower[0], rows.upper[0]) = (held, held);
            return;
        }
        let beyond = (self.bounds.0 - s).max(s - self.bounds.1) > POSITION_TOLERANCE;
        rows.outside[0] = beyond || self.equal.is_some();
        rows.upper[0] = bound(self.bounds.1 - s, w, braking, tick);
        rows.lower[0] = -bound(s - self.bounds.0, -w, braking, tick);
        if rows.lower[0] > rows.upper[0] {
            rows.lower[0] = rows.upper[0];
        }
    }
}

impl Rows for Row {
    fn kind(&self) -> Kind {
        Kind::User
    }

    fn names(&self) -> Vec<String> {
        vec![self.name.clone()]
    }

    fn sizes(&self) -> Vec<f64> {
        vec![self.size]
    }

    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn equality(&self) -> bool {
        self.equal.is_some() || (self.equality && self.braking.is_none())
    }

    fn asks_more(&self) -> bool {
        self.braking.is_some() || self.equal == Some(Equal::Positions)
    }

    fn fit(&mut self, limits: &LimitSet) -> Result<(), LimitError> {
        let ((low, high), (least, most)) = (self.reach(limits), self.bounds);
        if self.hard && (most < low - AT || least > high + AT) {
            let value = if most < low { most } else { least };
            let asked = if self.equality { "to be" } else { "to reach" };
            return Err(LimitError::Unusable {
                what: format!(
                    "row '{}' asks its sum {asked} {value}, and the limits of its joints leave it {low} to {high}, all in the unit of the sum",
                    self.name
                ),
                next: "ask for a value in that range",
            });
        }
        let all = |t: &Term| t.coefficient.abs() * limits.acceleration[t.dof];
        let most = self.terms.iter().map(all).sum::<f64>();
        if self.braking.is_some_and(|braking| braking > most) {
            (self.braking, self.size) = (Some(most), most); // more is counted on in vain
        }
        if self.equal == Some(Equal::Positions) && self.braking.is_none() {
            let own = |t: &Term| t.coefficient.abs() * limits.braking[t.dof].min(limits.acceleration[t.dof]);
            let least = self.terms.iter().map(own).fold(f64::INFINITY, f64::min);
            let braking = if least.is_finite() { least } else { self.steepest };
            (self.braking, self.size) = (Some(braking), braking);
        }
        Ok(())
    }

    fn in_proportion(&self) -> Vec<usize> {
        if self.kept { self.terms.iter().map(|t| t.dof).collect() } else { Vec::new() }
    }

    /// With an acceleration in it the sum is of a motion: at rest or in flight, another acceleration gives the same state another sum.
    fn of_state(&self) -> bool {
        self.terms.iter().all(|t| t.quantity != Quantity::Acceleration)
    }

    fn fill(&mut self, tick: &mut TickStart<'_>, rows: &mut RowsMut<'_>) {
        let (t, kappa) = (tick.period.dt, tick.period.kappa);
        if let Some(braking) = self.braking {
            return self.fill_braking(braking, tick, rows);
        }
        let mut still = 0.0;
        for term in &self.terms {
            let (i, c) = (term.dof, term.coefficient);
            let (g, constant) = match term.quantity {
                Quantity::Position => (kappa * t, tick.q[term.idx_q] + t * tick.v[i]),
                Quantity::Velocity => (1.0, tick.v[i]),
                Quantity::Acceleration => (1.0 / t, 0.0),
            };
            rows.row(0)[i] += c * g;
            still += c * constant;
        }
        let (mut lower, mut upper) = self.bounds;
        if self.equal == Some(Equal::Speeds) {
            // Beside its value, no further from it.
            let now = self.value(tick.q, tick.v, None);
            rows.outside[0] = (now - lower).abs() > AT_SPEED * self.size;
            if rows.outside[0] {
                (lower, upper) = (lower.min(now), upper.max(now));
            }
        }
        (rows.lower[0], rows.upper[0]) = (lower - still, upper - still);
    }

    fn excess(&mut self, motion: &mut Motion<'_>, excess: &mut [f64]) {
        if let Some(braking) = self.braking {
            let (s, w) = self.sum(motion.q, motion.v);
            if self.equal.is_some() {
                // No further from its value than the state is and leads; at it, as slow too.
                let (to, then) = self.sum(motion.q_next, motion.v_next);
                let (t, e) = (motion.period.dt, self.bounds.0);
                let slow = if self.is_at((s, w), motion.period) { t * then.abs() } else { 0.0 };
                excess[0] = ((to - e).abs().max(slow) - (s - e).abs() - t * w.abs()) / self.steepest;
                return;
            }
            let a: f64 = self.terms.iter().map(|t| t.coefficient * motion.acceleration[t.dof]).sum();
            let limit = |d: f64, w: f64| {
                if d.is_finite() { approach(d, w, braking, motion.period) } else { f64::INFINITY }
            };
            let (upper, lower) = (limit(self.bounds.1 - s, w), -limit(s - self.bounds.0, -w));
            excess[0] = (a - upper).max(lower.min(upper) - a) / self.size;
            return;
        }
        let value = self.value(motion.q_next, motion.v_next, Some(motion.acceleration));
        let (mut lower, mut upper) = self.bounds;
        if self.equal == Some(Equal::Speeds) {
            let now = self.value(motion.q, motion.v, None);
            if (now - lower).abs() > AT_SPEED * self.size {
                (lower, upper) = (lower.min(now), upper.max(now));
            }
        }
        excess[0] = (value - upper).max(lower - value) / self.size;
    }

    /// Beyond the bounds where the motion ends. A row that standing still breaks is none that a brake can keep.
    fn breach(&mut self, motion: &mut Motion<'_>, breach: &mut [f64]) {
        let value = |row: &Row| row.value(motion.q_next, motion.v_next, Some(motion.acceleration));
        if let Some(equal) = self.equal {
            let (off, positions) = ((value(self) - self.bounds.0).abs(), equal == Equal::Positions);
            breach[0] = match self.kept {
                true if positions => (off - 2.0 * self.keeping(motion.period).0) / self.steepest,
                true => off / self.size - AT_SPEED,
                false => f64::NEG_INFINITY,
            };
            return;
        }
        if self.braking.is_some() {
            let s = value(self);
            breach[0] = (s - self.bounds.1).max(self.bounds.0 - s) / self.steepest;
            return;
        }
        let of_positions = self.terms.iter().any(|t| t.quantity == Quantity::Position);
        let stands = self.bounds.0 <= 0.0 && self.bounds.1 >= 0.0;
        match !self.equality && (of_positions || stands) {
            true => self.excess(motion, breach),
            false => breach[0] = f64::NEG_INFINITY,
        }
    }
}

fn bound(d: f64, w: f64, braking: f64, tick: &TickStart<'_>) -> f64 {
    if d.is_finite() { approach(d, w, braking, tick.period) } else { f64::INFINITY }
}
