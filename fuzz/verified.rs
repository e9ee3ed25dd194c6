//! Damaged flight logs before `nearl verify`: a tick whose target or action is beyond a limit is never called verified, whatever else its
//! message says.

use std::path::Path;
use std::time::Duration;

use mcap::read::ChunkFlattener;
use mcap::records::Record;
use nearl_runtime::constraints::Model;
use nearl_verify::verify;
use serde_json::{Value, json};

use crate::assert_sentence;
use crate::attack::Attack;
use crate::log::{Part, again, within};
use crate::mutate::{Rng, mutate};

const PANDA: &str = include_str!("../examples/robots/panda/panda.urdf");
/// Shares of the robot file's limits, a margin [rad] and an acceleration [rad/s²].
const SPEED: f64 = 0.5;
const TORQUE: f64 = 0.8;
const MARGIN: f64 = 0.01;
const ACCELERATION: f64 = 25.0;
/// Control period [s].
const DT: f64 = 0.001;
/// Beyond a limit by more than rounding, and of a motor's force by more than the size of an action's.
const BEYOND: f64 = 1e-6;
const BEYOND_FORCE: f64 = 1e-3;

/// The flight that is damaged.
pub fn flight() -> Attack {
    Attack {
        urdf: PANDA.into(),
        start: vec![0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8],
        constraints: format!(
            "position = {{ margin = {MARGIN:?} }}\nvelocity = {{ scale = {SPEED:?} }}\nacceleration = {{ limit = {ACCELERATION:?} }}\n\
             torque = {{ scale = {TORQUE:?} }}\nbraking = \"stored\""
        ),
        dt: DT,
        sub_steps: 1,
        plant_steps: 0,
        policy_every: 10,
        seed: 5,
        ticks: 40,
        moves: Vec::new(),
        pause: Duration::ZERO,
        lost: 0,
        late: 0,
        lag: 0.0,
        drive_damping: 0.0,
    }
}

/// What a tick may not leave, by joint.
pub struct Limits {
    lower: Vec<f64>,
    upper: Vec<f64>,
    speed: Vec<f64>,
    force: Vec<f64>,
}

impl Limits {
    pub fn new() -> Limits {
        let model = Model::from_urdf_text(PANDA).expect("robot");
        let each = |of: &[f64], f: &dyn Fn(f64) -> f64| of.iter().map(|x| f(*x)).collect::<Vec<f64>>();
        Limits {
            lower: each(model.lower_position_limit(), &|q| q + MARGIN),
            upper: each(model.upper_position_limit(), &|q| q - MARGIN),
            speed: each(model.velocity_limit(), &|v| v * SPEED),
            force: each(model.effort_limit(), &|tau| tau * TORQUE),
        }
    }

    /// Whether a message says of its tick that it broke a limit. One that was outside at its start may still be.
    fn are_broken(&self, tick: &Value) -> bool {
        let (Some(q), Some(v), Some(tau)) =
            (numbers(&tick["target_q"]), numbers(&tick["target_v"]), numbers(&tick["action"]))
        else {
            return false;
        };
        let n = self.speed.len();
        if [q.len(), v.len(), tau.len()] != [n; 3] || self.may_recover(tick) {
            return false;
        }
        (0..n).any(|i| {
            v[i].abs() > self.speed[i] + BEYOND
                || q[i] < self.lower[i] - BEYOND
                || q[i] > self.upper[i] + BEYOND
                || tau[i].abs() > self.force[i] + BEYOND_FORCE
        })
    }

    /// It says that it recovers, and does not say that it began well inside.
    fn may_recover(&self, tick: &Value) -> bool {
        let state = &tick["state"];
        let (Some(q), Some(v)) = (numbers(&state["q"]), numbers(&state["v"])) else { return true };
        let well_inside = |i: usize| {
            let way = v[i] * v[i] / ACCELERATION + 2.0 * DT * v[i].abs();
            v[i].abs() < self.speed[i] && q[i] - self.lower[i] > way && self.upper[i] - q[i] > way
        };
        let is_inside = q.len() == self.speed.len() && v.len() == q.len() && (0..q.len()).all(well_inside);
        tick["ledger"]["status"] == 3 && !(is_inside && tick["sensed"] == "measured")
    }

    pub fn damage(&self, rng: &mut Rng, base: &[u8], other: &[u8]) -> Vec<u8> {
        let damaged = match rng.below(3) {
            0 => Some(mutate(rng, base, other)),
            1 => within(rng, base),
            _ => self.beyond(rng, base),
        };
        damaged.unwrap_or_else(|| base.to_vec())
    }

    /// Takes ticks beyond a limit, and changes what else they say, so that it may fit.
    fn beyond(&self, rng: &mut Rng, base: &[u8]) -> Option<Vec<u8>> {
        let victim = 4 + rng.below(40);
        again(base, &mut |n, part, data| {
            let is_hit = matches!(part, Part::Message) && (n == victim || rng.below(20) == 0);
            match serde_json::from_slice::<Value>(data) {
                Ok(mut tick) if is_hit && self.has_all(&tick) => {
                    self.push(rng, &mut tick);
                    (0..rng.below(4)).for_each(|_| cover(rng, &mut tick));
                    tick.to_string().into_bytes()
                }
                _ => data.to_vec(),
            }
        })
    }

    /// It is a tick with a target and an action for each joint.
    fn has_all(&self, tick: &Value) -> bool {
        let is_whole = |key: &str| tick[key].as_array().is_some_and(|x| x.len() == self.speed.len());
        ["target_q", "target_v", "action"].into_iter().all(is_whole)
    }

    /// One number beyond its limit by anything from a hair to its size.
    fn push(&self, rng: &mut Rng, tick: &mut Value) {
        let i = rng.below(self.speed.len());
        let sign = if rng.below(2) == 0 { 1.0 } else { -1.0 };
        let more = 10f64.powi(-(rng.below(6) as i32));
        match rng.below(3) {
            0 => {
                let v = sign * (self.speed[i] + more);
                // Its position may follow, so that the two belong together.
                if let (Some(q), 0) = (tick["state"]["q"][i].as_f64(), rng.below(2)) {
                    tick["target_q"][i] = (q + DT * v).into();
                }
                tick["target_v"][i] = v.into();
            }
            1 if sign > 0.0 => tick["target_q"][i] = (self.upper[i] + more).into(),
            1 => tick["target_q"][i] = (self.lower[i] - more).into(),
            _ => tick["action"][i] = (sign * (self.force[i] + 10.0 * more)).into(),
        }
    }
}

/// Says something else of a tick.
fn cover(rng: &mut Rng, tick: &mut Value) {
    match rng.below(9) {
        0 => {
            tick["ledger"]["status"] =
                (*rng.pick(&[0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 12, 13, 20, 21, 99])).into()
        }
        1 => tick["ledger"]["active_rows"] = json!([]),
        2 => tick["ledger"]["active"] = rng.below(9).into(),
        3 => tick["brake"] = json!([]),
        4 => tick["brake"] = json!([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
        5 => tick["sensed"] = (*rng.pick(&["measured", "predicted", "none", ""])).into(),
        6 => tick["mode"] = (*rng.pick(&["active", "braking", "hold", "fault"])).into(),
        7 => tick["state"] = json!({ "q": tick["target_q"], "v": tick["target_v"] }),
        _ => tick["ledger"]["target_violations"] = rng.below(3).into(),
    }
}

fn numbers(of: &Value) -> Option<Vec<f64>> {
    of.as_array()?.iter().map(|x| x.as_f64().or(x.is_null().then_some(f64::NAN))).collect()
}

/// Ticks of a log, and those that broke a limit by their own word; `None` of a file that is damaged as such.
fn told(bytes: &[u8], limits: &Limits) -> Option<(u64, u64)> {
    let (mut ticks, mut broken) = (0, 0);
    for part in ChunkFlattener::new(bytes).ok()? {
        match part.ok()? {
            Record::DataEnd(_) => break,
            Record::Message { data, .. } => {
                let Ok(message) = serde_json::from_slice::<Value>(&data) else { return None };
                // Snapshots have a digest in place of a tick; what a replay goes on from has no target.
                if message.get("target_v").is_some() {
                    (ticks, broken) = (ticks + 1, broken + u64::from(limits.are_broken(&message)));
                }
            }
            _ => {}
        }
    }
    Some((ticks, broken))
}

/// Ticks that broke a limit in all that was read.
pub fn read(file: &Path, bytes: &[u8], limits: &Limits) -> u64 {
    std::fs::write(file, bytes).expect("log");
    match verify(file) {
        Err(error) => {
            assert_sentence(&error.to_string(), &["flight.mcap"]);
            0
        }
        Ok(report) => {
            assert!(report.verified <= report.ticks, "{report}");
            assert!(report.optimal.max(report.stoppable) <= report.verified, "{report}");
            let Some((ticks, broken)) = told(bytes, limits) else { return 0 };
            if ticks != report.ticks {
                return 0;
            }
            assert!(
                report.verified + broken <= ticks,
                "{broken} ticks are beyond a limit, and this is said:\n{report}"
            );
            assert!(broken == 0 || !report.is_whole(), "{broken} ticks are beyond a limit:\n{report}");
            broken
        }
    }
}
