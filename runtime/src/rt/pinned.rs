//! The limits belong to the loop: fixed at its start, and a pushed snapshot may tighten them but never loosen them.
//!
//! What is fixed are numbers and sections: the [`LimitSet`] of every joint, the sections of the other kinds ([`section`]), the way to
//! brake, the actuators' range, the period, and the robot itself, of which the torque rows are made. Everything a snapshot brings is compared
//! before its controller is built.

mod section;

use nearl_constraints::limit::REGISTRY;
use nearl_constraints::{Braking, Consistency, ConstraintSettings, Dynamics, LimitSet, Model};
use serde_json::Value;
use std::path::Path;

use crate::controller::Parts;
use crate::link::Verdict;
use crate::rt::tick::Refusal;
use crate::snapshot::{Manifest, SnapshotError};
use crate::task::{IdmKind, Task};

/// Numbers that differ by less than this share are the same: a robot file may have been written anew.
const SAME: f64 = 1e-9;
/// Periods further apart than this [s] cannot both be within the 1e-9 s that a plant's may differ by.
const OTHER_PERIOD: f64 = 1e-8;
/// Kinds whose whole effect is in the box of single joints, or that [`Pinned::ways`] compares. What any other kind asks for is compared
/// section by section, so that a kind that is new is not loosened without a word.
const IN_THE_BOX: [&str; 5] = ["position", "velocity", "acceleration", "velocity_profile", "locked"];
/// States in which two robots are compared, and by how much their motor forces may differ [share of the largest].
const STATES: usize = 5;

/// Limits fixed at the start of a loop.
pub struct Pinned {
    /// Where they come from, for messages.
    source: String,
    joints: Vec<String>,
    controllable: Vec<usize>,
    set: LimitSet,
    constraints: ConstraintSettings,
    manifest: Manifest,
    model: Model,
}

impl std::fmt::Debug for Pinned {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pinned").field("source", &self.source).finish_non_exhaustive()
    }
}

impl Pinned {
    /// Those of the snapshot with `manifest`; `source` names it in refusals.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn of(manifest: &Manifest, source: &str) -> Result<Pinned, SnapshotError> {
        let Parts { model, layout, projector } = Parts::new(manifest)?;
        Ok(Pinned {
            source: source.to_owned(),
            joints: (0..model.nv()).map(|i| model.dof_name(i)).collect(),
            controllable: layout.controllable().to_vec(),
            set: projector.limits().clone(),
            constraints: manifest.task.constraints.clone(),
            manifest: manifest.clone(),
            model,
        })
    }

    /// Those that `[constraints]` of the TOML file `path` asks for, on the robot of `manifest`: a task file, or that section alone.
    ///
    /// # Errors
    /// [`SnapshotError::Unusable`] with file and key, or the sentence of the layer that refused.
    pub fn read(path: &Path, manifest: &Manifest) -> Result<Pinned, SnapshotError> {
        let file = path.display().to_string();
        let unusable =
            |reason: String| SnapshotError::Unusable { reason: format!("limits file '{file}': {reason}") };
        let constraints =
            Task::read_constraints(path).map_err(|e| SnapshotError::Unusable { reason: e.to_string() })?;
        let mut manifest = manifest.clone();
        manifest.task.constraints = constraints;
        Pinned::of(&manifest, &format!("'{file}'")).map_err(|e| unusable(e.to_string()))
    }

    /// The section `[constraints]` that is fixed, as JSON for the flight log.
    pub fn to_json(&self) -> String {
        serde_json::to_string(&self.constraints).unwrap_or_else(|e| unreachable!("constraints: {e}"))
    }

    /// Where the limits come from.
    pub fn source(&self) -> &str {
        &self.source
    }

    /// Refuses a snapshot that would loosen anything; everything found is named, the first few in the text.
    ///
    /// # Errors
    /// [`Verdict::Looser`] with joint, kind, both numbers and the unit; what [`Parts::new`] refuses.
    pub fn admit(&self, manifest: &Manifest) -> Result<(), Refusal> {
        let unusable = |e: SnapshotError| Refusal { verdict: Verdict::of(&e), text: e.to_string() };
        let parts = Parts::new(manifest).map_err(unusable)?;
        let names: Vec<String> = (0..parts.model.nv()).map(|i| parts.model.dof_name(i)).collect();
        let apart = (manifest.task.time.dt - self.manifest.task.time.dt).abs();
        if names != self.joints || apart > OTHER_PERIOD {
            // Another robot or period altogether: named where the plant is compared, which refuses it.
            return Ok(());
        }
        let mut found = self.ways(manifest);
        found.extend(self.joints_of(&parts));
        found.extend(self.sections(manifest));
        found.extend(self.robot(manifest, &parts.model));
        if found.is_empty() {
            return Ok(());
        }
        let text = format!(
            "looser than the limits of the loop ({}): {}; train within them, or start the loop with --allow-looser",
            self.source,
            first_few(&found)
        );
        Err(Refusal { verdict: Verdict::Looser, text })
    }

    /// How the limits are kept: projection, braking, inverse dynamics, period, actuators.
    fn ways(&self, new: &Manifest) -> Vec<String> {
        let (old, mut found) = (&self.manifest, Vec::new());
        let mut say = |is_looser: bool, text: String| is_looser.then(|| found.push(text));
        say(old.proposes() && !new.proposes(), "its policy is direct, so nothing is projected".into());
        // Actions of a network obey as far as they are guarded; torques of a projected state obey by themselves.
        let keeps = |m: &Manifest| m.guards() || (m.proposes() && m.task.idm.kind == IdmKind::Pinocchio);
        let loses_guard = old.guards() && !keeps(new);
        say(loses_guard, "its actions are not guarded where those of the loop are".into());
        let loses_drives = old.bounds_drives() && !new.bounds_drives() && !keeps(new);
        say(
            loses_drives,
            "the forces of its drives are not bounded where those of the loop are (guard = \"drive\")".into(),
        );
        let (kept, brought) = (&self.constraints, &new.task.constraints);
        if let Some(was) = kept.reached
            && brought.reached.is_none_or(|is| above(is, was))
        {
            say(
                true,
                match brought.reached {
                    Some(is) => format!("constraints.reached = {is} where the loop has {was}"),
                    None => format!("no constraints.reached where the loop has {was}"),
                },
            );
        }
        // Of a braking that is chosen nobody knows here whether it is the stored one.
        let worth =
            |braking| [Braking::Certified, Braking::Auto, Braking::Stored].iter().position(|b| *b == braking);
        let loses_brake = worth(brought.braking) < worth(kept.braking);
        let name = |braking: Braking| format!("{braking:?}").to_lowercase();
        let (was, is) = (name(kept.braking), name(brought.braking));
        say(loses_brake, format!("braking = \"{is}\" where the loop has \"{was}\""));
        let splits =
            kept.consistency == Consistency::Kinematic && brought.consistency != Consistency::Kinematic;
        say(splits, "consistency = \"free\" where the loop has \"kinematic\"".into());
        let learns = keeps(old) && !old.guards() && new.proposes() && !keeps(new);
        say(learns, "a learned inverse model where the loop has the analytic one".into());
        let (then, now) = (old.task.sub_steps(), new.task.sub_steps());
        say(then != now, format!("{now} physics steps in a period where the loop has {then}"));
        let ranges = |m: &Manifest| -> Vec<(f64, f64)> {
            m.action_lower.iter().copied().zip(m.action_upper.iter().copied()).collect()
        };
        for (i, (was, is)) in ranges(old).into_iter().zip(ranges(new)).enumerate() {
            let wider = above(is.1, was.1) || above(-is.0, -was.0);
            say(
                wider,
                format!("action {i} from {} to {} where the loop has {} to {}", is.0, is.1, was.0, was.1),
            );
        }
        found
    }

    /// Joint by joint.
    fn joints_of(&self, parts: &Parts) -> Vec<String> {
        let (old, new, mut found) = (&self.set, parts.projector.limits(), Vec::new());
        for &i in &self.controllable {
            let joint = &self.joints[i];
            if !parts.layout.controllable().contains(&i) {
                found.push(format!("joint '{joint}' is not controllable, so none of its limits is kept"));
                continue;
            }
            let unit = UNITS;
            let mut more = |what: &str, is: f64, was: f64, unit: &str| {
                if above(is, was) {
                    found.push(format!("{what} of joint '{joint}' {is} {unit} where the loop has {was}"));
                }
            };
            more("highest position", new.q_upper[i], old.q_upper[i], unit[0]);
            more("velocity", new.velocity[i], old.velocity[i], unit[1]);
            more("acceleration", new.acceleration[i], old.acceleration[i], unit[2]);
            more("braking", new.braking[i], old.braking[i], unit[2]);
            more("torque", new.effort[i], old.effort[i], unit[3]);
            if above(-new.q_lower[i], -old.q_lower[i]) {
                let (is, was) = (new.q_lower[i], old.q_lower[i]);
                found.push(format!(
                    "lowest position of joint '{joint}' {is} {} where the loop has {was}",
                    unit[0]
                ));
            }
            if old.locked[i] && !new.locked[i] {
                found.push(format!("joint '{joint}' is not locked"));
            }
            if old.profile[i].iter().zip(&new.profile[i]).any(|(was, is)| was.is_some() && was != is) {
                found.push(format!("another velocity profile of joint '{joint}'"));
            }
        }
        found
    }

    /// The kinds that are more than numbers by joint.
    fn sections(&self, new: &Manifest) -> Vec<String> {
        let value = |settings: &ConstraintSettings| {
            serde_json::to_value(settings).unwrap_or_else(|e| unreachable!("constraints: {e}"))
        };
        let (old, new) = (value(&self.constraints), value(&new.task.constraints));
        let joints: Vec<&str> = self.joints.iter().map(String::as_str).collect();
        let of = |all: &Value, kind: &str| all.get(kind).cloned().unwrap_or(Value::Null);
        let kinds = REGISTRY.iter().map(|entry| entry.name).filter(|name| !IN_THE_BOX.contains(name));
        kinds
            .chain(["action"])
            .filter_map(|kind| section::looser(kind, &of(&old, kind), &of(&new, kind), &joints))
            .collect()
    }

    /// What acts on a joint beside its motor, and what its motor carries with it.
    fn passive(&self, model: &Model) -> Option<String> {
        let old = &self.model;
        let numbers: [(&str, &[f64], &[f64], &str); 6] = [
            ("damping", model.damping(), old.damping(), "N m s/rad or N s/m"),
            ("damping of its drive", model.drive_damping(), old.drive_damping(), "N m s/rad or N s/m"),
            ("stiffness", model.stiffness(), old.stiffness(), "N m/rad or N/m"),
            ("rest position of its spring", model.spring_reference(), old.spring_reference(), UNITS[0]),
            ("dry friction", model.friction(), old.friction(), UNITS[3]),
            ("armature", model.armature(), old.armature(), "kg m² or kg"),
        ];
        let other = |i: usize| {
            let number = numbers.iter().find(|(_, is, was, _)| above(is[i], was[i]) || above(was[i], is[i]));
            let said = number.map(|(what, is, was, unit)| {
                format!("{what} {} {unit} where the loop reckons with {}", is[i], was[i])
            });
            let rubs = (model.friction_law()[i], model.friction_onset()[i])
                != (old.friction_law()[i], old.friction_onset()[i]);
            said.or_else(|| {
                (rubs && model.friction()[i] > 0.0).then(|| "dry friction that sets in otherwise".into())
            })
        };
        (0..model.nv().min(old.nv()))
            .find_map(|i| Some(format!("another robot: joint '{}' has {}", self.joints[i], other(i)?)))
    }

    /// The robot that the torque rows and the inverse dynamics are made of, by its motor forces in a few states.
    fn robot(&self, new: &Manifest, model: &Model) -> Option<String> {
        if let Some(other) = self.passive(model) {
            return Some(other);
        }
        let (old, new) = (&self.manifest.robot, &new.robot);
        let same = old.gravity == new.gravity && old.bodies == new.bodies;
        if same && old.frames == new.frames && old.solids == new.solids {
            return None;
        }
        let needs_frames = !(self.constraints.frame.is_empty() && self.constraints.frame_speed.is_empty());
        if needs_frames && (old.frames != new.frames || !same) {
            return Some("another robot: its frames are elsewhere".into());
        }
        if self.constraints.collision.is_some() && (old.solids != new.solids || !same) {
            return Some("another robot: its solids are others".into());
        }
        if model.nq() != self.model.nq() {
            return Some("another robot".into());
        }
        let (mut was, mut is) = (Dynamics::new(&self.model), Dynamics::new(model));
        let nv = model.nv();
        let (mut a, mut b) = (vec![0.0; nv], vec![0.0; nv]);
        let mut dq = vec![0.0; nv];
        for state in 0..STATES {
            let wave = |i: usize, k: usize| ((1 + state * nv + i + 7 * k) as f64 * 0.7).sin();
            (0..nv).for_each(|i| dq[i] = wave(i, 0));
            let mut q = model.neutral();
            was.integrate(&model.neutral(), &dq, &mut q);
            let (v, acc): (Vec<f64>, Vec<f64>) = (0..nv).map(|i| (wave(i, 1), wave(i, 2))).unzip();
            was.rnea(&q, &v, &acc, &mut a);
            is.rnea(&q, &v, &acc, &mut b);
            let largest = a.iter().fold(1e-6, |m, x| f64::max(m, x.abs()));
            let differs = |&i: &usize| {
                let off = (a[i] - b[i]).abs();
                off.is_nan() || off > SAME.sqrt() * largest
            };
            if let Some(i) = (0..nv).find(differs) {
                let joint = &self.joints[i];
                return Some(format!(
                    "another robot: the same motion takes {:.4} N m or N at joint '{joint}' where the loop reckons with {:.4}",
                    b[i], a[i]
                ));
            }
        }
        None
    }
}

/// The first three clauses, and how many more there are.
pub(crate) fn first_few(found: &[String]) -> String {
    let (shown, more) = (found.len().min(3), found.len().saturating_sub(3));
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    format!("{}{more}", found[..shown].join("; "))
}

/// `is > was`, beyond rounding.
pub(crate) fn above(is: f64, was: f64) -> bool {
    is > was + SAME * was.abs().max(1.0) && is != was
}

/// Units of position, velocity, acceleration and force of a degree of freedom.
pub(crate) const UNITS: [&str; 4] = ["rad or m", "rad/s or m/s", "rad/s² or m/s²", "N m or N"];

#[cfg(test)]
mod tests {
    use super::{IN_THE_BOX, REGISTRY};

    /// A name that is misspelt here would leave its kind to nobody.
    #[test]
    fn kinds_in_the_box_are_kinds() {
        assert!(IN_THE_BOX.iter().all(|name| REGISTRY.iter().any(|entry| entry.name == *name)));
    }
}
