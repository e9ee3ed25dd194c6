//! What robots have in shared memory now, and whether a living process still holds it.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;

use iceoryx2::prelude::{CallbackProgression, Node, NodeState};

use super::service::Ipc;
use super::{RobotName, home, memory};

/// Shared memory of one robot name.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Remains {
    /// Robot.
    pub name: String,
    /// Processes that hold it.
    pub alive: usize,
    /// Processes that died without leaving.
    pub dead: usize,
    /// Memory taken \[bytes\].
    pub bytes: u64,
    /// A process has links of the robot now.
    pub held: bool,
}

impl Remains {
    /// True if nobody but dead processes holds it.
    pub fn is_stale(&self) -> bool {
        !self.held
    }
}

/// Every robot name of this user with shared memory or files on this machine, sorted by name. What another user called so is none of them.
pub fn remains() -> Vec<Remains> {
    let mut sizes: BTreeMap<String, u64> = BTreeMap::new();
    for entry in memory::files("nearl.") {
        let file = entry.file_name().to_string_lossy().into_owned();
        let name = file.strip_prefix("nearl.").and_then(|rest| rest.split_once('.')).map(|(name, _)| name);
        if let (Some(name), Ok(meta)) = (name, entry.metadata()) {
            *sizes.entry(name.to_owned()).or_default() += 512 * meta.blocks();
        }
    }
    for (entry, _) in home::own_entries(&home::of_user()) {
        let name = entry.file_name().to_string_lossy().into_owned();
        let Ok(robot) = RobotName::new(&name) else { continue };
        if home::has_files(&robot) || home::is_held(&robot) {
            let files = home::own_entries(&entry.path());
            let bytes = files.filter(|(_, m)| m.is_file()).map(|(_, m)| 512 * m.blocks());
            *sizes.entry(name).or_default() += bytes.sum::<u64>();
        }
    }
    sizes.into_iter().filter_map(|(name, bytes)| of(&name, bytes)).collect()
}

fn of(name: &str, bytes: u64) -> Option<Remains> {
    let robot = RobotName::new(name).ok()?;
    let mut remains =
        Remains { name: name.to_owned(), alive: 0, dead: 0, bytes, held: home::is_held(&robot) };
    if robot.token().is_none() {
        return Some(remains);
    }
    let config = robot.config().ok()?;
    let count = |state| {
        match state {
            NodeState::<Ipc>::Alive(_) | NodeState::Inaccessible(_) => remains.alive += 1,
            NodeState::Dead(_) | NodeState::Undefined(_) => remains.dead += 1,
        }
        CallbackProgression::Continue
    };
    Node::<Ipc>::list(&config, count).ok()?;
    Some(remains)
}
