//! Which observation entries are joint positions and velocities, which of them the policy
//! proposes, and which joints the projector may move.
//!
//! Names: `q.<joint>` and `v.<joint>` are the position and velocity of a joint with one degree of
//! freedom; `q.<joint>.<part>` and `v.<joint>.<part>` are parts of a joint with several (a free base), which
//! the projector never moves (in MuJoCo's convention, [`parts_of`]); every other name is free (a goal, a contact force, a camera feature).

use crate::convention;
use crate::model::{Joint, Model};

/// What one observation entry is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Entry {
    /// Position of a one-dof joint: index into `q` (nq) and degree of freedom (nv).
    Position {
        /// Index into the configuration `q`.
        idx_q: usize,
        /// Index into the velocity `v`.
        dof: usize,
    },
    /// Velocity of a one-dof joint.
    Velocity {
        /// Index into the velocity `v`.
        dof: usize,
    },
    /// A part of a joint with several degrees of freedom, or anything the robot model does not know.
    Other,
}

/// Names of the parts of a joint of `nq` configuration entries and `nv` degrees of freedom, as in `q.root.qw` and `v.root.wx`: an empty name for one
/// that has no parts.
pub fn parts_of(nq: usize, nv: usize) -> (&'static [&'static str], &'static [&'static str]) {
    const POSITION: [&str; 7] = [".x", ".y", ".z", ".qw", ".qx", ".qy", ".qz"];
    const VELOCITY: [&str; 6] = [".x", ".y", ".z", ".wx", ".wy", ".wz"];
    match (nq, nv) {
        (7, 6) => (&POSITION, &VELOCITY),
        (4, 3) => (&POSITION[3..], &VELOCITY[3..]),
        _ => (&[""], &[""]),
    }
}

/// A joint of several degrees of freedom of which the observation holds every part.
#[derive(Clone, Debug)]
struct Observed {
    joint: Joint,
    /// Observation index of each part.
    position: Vec<usize>,
    velocity: Vec<usize>,
}

/// Why a layout was refused. Each message names the entry and the next step.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// A name appears twice in one list.
    #[error("state.{list} names '{name}' twice; name each entry once")]
    Duplicate {
        /// Key of the list in the task file.
        list: &'static str,
        /// The repeated name.
        name: String,
    },
    /// A `q.` or `v.` entry, or a controllable joint, that the robot does not have.
    #[error("state.{list} names '{name}', but {reason}")]
    UnknownJoint {
        /// Key of the list in the task file.
        list: &'static str,
        /// The entry as written.
        name: String,
        /// What the model says, with near names.
        reason: String,
    },
    /// A proposed entry that is not observed.
    #[error(
        "state.propose names '{name}', which state.observation does not list; observe it or do not propose it"
    )]
    NotObserved {
        /// The entry as written.
        name: String,
    },
    /// A controllable joint none of whose states is proposed.
    #[error(
        "state.controllable names joint '{joint}', but state.propose has neither 'q.{joint}' nor 'v.{joint}'; propose one of them or take the joint out"
    )]
    NotProposed {
        /// The joint.
        joint: String,
    },
    /// The list of proposed entries is empty.
    #[error("state.propose is empty; name at least one entry of state.observation")]
    NothingProposed,
}

/// The observation (n_obs entries), the proposed state (n_state of them) and the controllable subset S_c.
#[derive(Clone, Debug)]
pub struct StateLayout {
    names: Vec<String>,
    entries: Vec<Entry>,
    state: Vec<usize>,
    controllable: Vec<usize>,
    controllable_state: Vec<usize>,
    /// Joints of several degrees of freedom.
    whole: Vec<Observed>,
}

impl StateLayout {
    /// Reads the three lists of the task file against the robot.
    ///
    /// `observation`: all entries in the order the environment gives them. `propose`: the entries the
    /// policy proposes (`None`: all). `controllable`: joints the projector may move (`None`: every joint
    /// with a proposed `q.` or `v.` entry).
    ///
    /// # Errors
    /// [`LayoutError`] for a repeated, unknown or inconsistent name.
    pub fn new(
        model: &Model,
        observation: &[String],
        propose: Option<&[String]>,
        controllable: Option<&[String]>,
    ) -> Result<Self, LayoutError> {
        unique("observation", observation)?;
        let entries = observation.iter().map(|n| entry(model, n)).collect::<Result<Vec<_>, _>>()?;
        let state = match propose {
            None => (0..observation.len()).collect(),
            Some(names) => {
                unique("propose", names)?;
                let find = |n: &String| observation.iter().position(|o| o == n);
                names
                    .iter()
                    .map(|n| find(n).ok_or_else(|| LayoutError::NotObserved { name: n.clone() }))
                    .collect::<Result<Vec<_>, _>>()?
            }
        };
        if state.is_empty() {
            return Err(LayoutError::NothingProposed);
        }
        let proposed = |dof: usize| state.iter().any(|&i| dof_of(entries[i]) == Some(dof));
        let dofs = match controllable {
            None => (0..model.nv()).filter(|&d| proposed(d)).collect(),
            Some(joints) => {
                unique("controllable", joints)?;
                let mut dofs = Vec::with_capacity(joints.len());
                for name in joints {
                    let joint = one_dof("controllable", model, name, name)?;
                    if !proposed(joint.idx_v) {
                        return Err(LayoutError::NotProposed { joint: name.clone() });
                    }
                    dofs.push(joint.idx_v);
                }
                dofs
            }
        };
        let controllable_state = (0..state.len())
            .filter(|&k| dof_of(entries[state[k]]).is_some_and(|d| dofs.contains(&d)))
            .collect();
        let whole =
            model.joints().iter().filter(|j| j.nv > 1).filter_map(|j| whole(j, observation)).collect();
        Ok(Self {
            names: observation.to_vec(),
            entries,
            state,
            controllable: dofs,
            controllable_state,
            whole,
        })
    }

    /// Writes the positions and velocities of joints that an observation (n_obs) holds into `q` (nq) and `v` (nv); the others stay. Parts of a joint are
    /// in MuJoCo's convention, and it is written where all of them are there.
    pub fn read_state(&self, obs: &[f64], q: &mut [f64], v: &mut [f64]) {
        for (entry, value) in self.entries.iter().zip(obs) {
            match *entry {
                Entry::Position { idx_q, .. } => q[idx_q] = *value,
                Entry::Velocity { dof } => v[dof] = *value,
                Entry::Other => {}
            }
        }
        for Observed { joint, position, velocity } in &self.whole {
            position.iter().zip(&mut q[joint.idx_q..]).for_each(|(k, x)| *x = obs[*k]);
            velocity.iter().zip(&mut v[joint.idx_v..]).for_each(|(k, x)| *x = obs[*k]);
            convention::joint_from_mujoco(joint, q, v);
        }
    }

    /// The first entry of the joint's position and velocity that the observation lacks.
    pub fn first_unseen(&self, joint: &Joint) -> Option<String> {
        entries_of(joint).find(|name| !self.names.contains(name))
    }

    /// Names of the observation entries (n_obs).
    pub fn names(&self) -> &[String] {
        &self.names
    }
    /// What each observation entry is (n_obs).
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }
    /// Number of observation entries.
    pub fn n_obs(&self) -> usize {
        self.entries.len()
    }
    /// Number of proposed entries.
    pub fn n_state(&self) -> usize {
        self.state.len()
    }
    /// Observation index of each proposed entry (n_state).
    pub fn state(&self) -> &[usize] {
        &self.state
    }
    /// Degrees of freedom of S_c, in the order of the task file.
    pub fn controllable(&self) -> &[usize] {
        &self.controllable
    }
    /// Which of the proposed entries belong to S_c: indices into the proposed state.
    pub fn controllable_state(&self) -> &[usize] {
        &self.controllable_state
    }
    /// Name of proposed entry `k`.
    pub fn state_name(&self, k: usize) -> &str {
        &self.names[self.state[k]]
    }
    /// What proposed entry `k` is.
    pub fn state_entry(&self, k: usize) -> Entry {
        self.entries[self.state[k]]
    }
}

/// Names of all that is observed of a joint: its position, then its velocity.
fn entries_of(joint: &Joint) -> impl Iterator<Item = String> {
    let (position, velocity) = parts_of(joint.nq, joint.nv);
    let named = |kind: &str, part: &&str| format!("{kind}.{}{part}", joint.name);
    let position: Vec<String> = position.iter().map(|part| named("q", part)).collect();
    position.into_iter().chain(velocity.iter().map(|part| named("v", part)).collect::<Vec<_>>())
}

fn whole(joint: &Joint, observation: &[String]) -> Option<Observed> {
    let places = entries_of(joint).map(|name| observation.iter().position(|o| *o == name));
    let mut position: Vec<usize> = places.collect::<Option<_>>()?;
    let velocity = position.split_off(parts_of(joint.nq, joint.nv).0.len());
    (!position.is_empty()).then(|| Observed { joint: joint.clone(), position, velocity })
}

fn dof_of(entry: Entry) -> Option<usize> {
    match entry {
        Entry::Position { dof, .. } | Entry::Velocity { dof } => Some(dof),
        Entry::Other => None,
    }
}

fn unique(list: &'static str, names: &[String]) -> Result<(), LayoutError> {
    match names.iter().enumerate().find(|(i, n)| names[..*i].contains(n)) {
        Some((_, name)) => Err(LayoutError::Duplicate { list, name: name.clone() }),
        None => Ok(()),
    }
}

fn one_dof<'m>(
    list: &'static str,
    model: &'m Model,
    name: &str,
    joint: &str,
) -> Result<&'m Joint, LayoutError> {
    let refuse = |reason| LayoutError::UnknownJoint { list, name: name.into(), reason };
    let found = model.joint(joint).map_err(|e| refuse(e.to_string()))?;
    if found.nq != 1 || found.nv != 1 {
        return Err(refuse(format!(
            "joint '{joint}' has {} position and {} velocity entries; only joints with one of each can be projected: make a continuous joint of a \
             URDF a revolute one with lower and upper, and do not name joints of more freedom",
            found.nq, found.nv
        )));
    }
    Ok(found)
}

/// `root.qw` for a joint `root` with several degrees of freedom.
fn part_of_joint(model: &Model, name: &str) -> bool {
    name.rsplit_once('.').and_then(|(joint, _)| model.joint(joint).ok()).is_some_and(|j| j.nv > 1)
}

fn entry(model: &Model, name: &str) -> Result<Entry, LayoutError> {
    if name.strip_prefix("q.").or(name.strip_prefix("v.")).is_some_and(|rest| part_of_joint(model, rest)) {
        return Ok(Entry::Other);
    }
    if let Some(joint) = name.strip_prefix("q.") {
        let j = one_dof("observation", model, name, joint)?;
        return Ok(Entry::Position { idx_q: j.idx_q, dof: j.idx_v });
    }
    if let Some(joint) = name.strip_prefix("v.") {
        return Ok(Entry::Velocity { dof: one_dof("observation", model, name, joint)?.idx_v });
    }
    Ok(Entry::Other)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint that turns on and on has no angle to be observed: it is never read from an observation without a word.
    #[test]
    fn what_an_observation_cannot_hold_is_unseen() {
        let link = |name: &str| {
            format!(
                "<link name=\"{name}\"><inertial><mass value=\"1\"/><inertia ixx=\"1\" ixy=\"0\" ixz=\"0\" iyy=\"1\" iyz=\"0\" izz=\"1\"/></inertial></link>"
            )
        };
        let joint = |name: &str, kind: &str, parent: &str, child: &str| {
            format!(
                "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"{parent}\"/><child link=\"{child}\"/><axis xyz=\"0 0 1\"/>\
                 <limit lower=\"-1\" upper=\"1\" effort=\"1\" velocity=\"1\"/></joint>"
            )
        };
        let (turns, bends) = (joint("turns", "continuous", "a", "b"), joint("bends", "revolute", "b", "c"));
        let urdf = format!("<robot name=\"r\">{}{}{}{turns}{bends}</robot>", link("a"), link("b"), link("c"));
        let model = Model::from_urdf_text(&urdf).expect("robot");
        let names = ["q.bends", "v.bends"].map(str::to_owned);
        let layout = StateLayout::new(&model, &names, None, None).expect("layout");
        let unseen: Vec<_> = model.joints().iter().map(|joint| layout.first_unseen(joint)).collect();
        assert_eq!(unseen, [Some("q.turns".to_owned()), None]);
    }
}
