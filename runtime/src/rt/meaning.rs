//! What the numbers of an action mean to the robot. A robot is told once, when its driver is written: no snapshot may change it while a loop runs,
//! whatever limits it keeps.

use nearl_constraints::description::Motor;
use nearl_constraints::{Drive, Model};

use crate::controller::Parts;
use crate::link::Verdict;
use crate::rt::tick::Refusal;
use crate::snapshot::{Manifest, SnapshotError};

/// Numbers that differ by less than this share are the same: a robot file may have been written anew.
const SAME: f64 = 1e-9;

/// Each entry of the action, in order.
#[derive(Clone, Debug)]
pub struct Meaning(Vec<Entry>);

/// One entry of the action.
#[derive(Clone, Debug)]
struct Entry {
    joint: String,
    /// What the joint is commanded, in words with units and gains.
    command: String,
    is_effort: bool,
    motor: Motor,
}

impl Meaning {
    /// That of the snapshot with `manifest`.
    ///
    /// # Errors
    /// As [`Parts::new`].
    pub fn of(manifest: &Manifest) -> Result<Meaning, SnapshotError> {
        let Parts { model, layout, .. } = Parts::new(manifest)?;
        let controllable = layout.controllable();
        let drives = Parts::drives(manifest, &model, controllable)?;
        let dof = |joint: &str| (0..model.nv()).find(|&i| model.dof_name(i) == joint);
        let entries = motors(&model, controllable, manifest.action_lower.len());
        let entry = |motor: Motor| {
            let drive = dof(&motor.joint).and_then(|i| drives.get(i).copied()).unwrap_or_default();
            Entry {
                joint: motor.joint.clone(),
                command: drive.to_string(),
                is_effort: drive == Drive::Effort,
                motor,
            }
        };
        Ok(Meaning(entries.into_iter().map(entry).collect()))
    }

    /// Refuses a snapshot whose actions mean something else.
    ///
    /// # Errors
    /// [`Verdict::ForeignRobot`] with the first joint and both meanings; what [`Parts::new`] refuses.
    pub fn admit(&self, manifest: &Manifest) -> Result<(), Refusal> {
        let new =
            Meaning::of(manifest).map_err(|e| Refusal { verdict: Verdict::of(&e), text: e.to_string() })?;
        let counts = [self.0.len(), new.0.len()];
        let mut found =
            self.0.iter().zip(&new.0).enumerate().filter_map(|(k, (old, new))| differs(k, old, new));
        let first = found.next().or_else(|| {
            (counts[0] != counts[1])
                .then(|| format!("its action has {} entries where the loop's has {}", counts[1], counts[0]))
        });
        let Some(first) = first else { return Ok(()) };
        let more = match found.count() {
            0 => String::new(),
            more => format!(", and {more} more"),
        };
        let text = format!(
            "{first}{more}: the robot would take its numbers for something else; import or train it with the loop's [command] and motors, or start a \
             loop of its own"
        );
        Err(Refusal { verdict: Verdict::ForeignRobot, text })
    }
}

/// The motors behind the entries of an action: those of the controllable joints, or all of them where that is their number.
fn motors(model: &Model, controllable: &[usize], n: usize) -> Vec<Motor> {
    let mut all = model.motors().to_vec();
    all.sort_by_key(|motor| motor.order);
    let is_driven = |motor: &&Motor| controllable.iter().any(|&i| model.dof_name(i) == motor.joint);
    let driven: Vec<Motor> = all.iter().filter(is_driven).cloned().collect();
    if driven.len() == n { driven } else { all }
}

/// One clause if entry `k` means something else than before.
fn differs(k: usize, old: &Entry, new: &Entry) -> Option<String> {
    if old.joint != new.joint {
        return Some(format!(
            "action {k} is for joint '{}' where the loop's is for '{}'",
            new.joint, old.joint
        ));
    }
    let joint = &old.joint;
    if old.command != new.command {
        return Some(format!("joint '{joint}' is sent {} where the loop sends {}", new.command, old.command));
    }
    // A joint that follows by itself, or that a drive of the robot's own pulls, is sent what is written, whatever motor stands in the file.
    if !old.is_effort {
        return None;
    }
    if old.motor.command != new.motor.command {
        return Some(format!(
            "the motor of joint '{joint}' takes {} where the loop's takes {}",
            word(&new.motor),
            word(&old.motor)
        ));
    }
    let numbers = |m: &Motor| {
        [
            ("gear", m.gear),
            ("gain", m.gain),
            ("bias", m.bias[0]),
            ("bias by position", m.bias[1]),
            ("bias by velocity", m.bias[2]),
        ]
    };
    let mut pairs = numbers(&old.motor).into_iter().zip(numbers(&new.motor));
    let ((what, was), (_, is)) = pairs.find(|((_, a), (_, b))| (a - b).abs() > SAME * a.abs().max(1.0))?;
    Some(format!("the motor of joint '{joint}' has {what} {is} where the loop's has {was}"))
}

fn word(motor: &Motor) -> String {
    format!("{:?}", motor.command).to_lowercase()
}
