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
    /// When something of it changed last [s since 1970].
    pub changed: i64,
}

impl Remains {
    /// True if nobody but dead processes holds it.
    pub fn is_stale(&self) -> bool {
        !self.held
    }
}

/// Every robot name of this user with shared memory or files on this machine, sorted by name. What another user called so is none of them.
pub fn remains() -> Vec<Remains> {
    let mut found: BTreeMap<String, (u64, i64)> = BTreeMap::new();
    let mut add = |name: &str, bytes: u64, changed: i64| {
        let (all, last) = found.entry(name.to_owned()).or_default();
        (*all, *last) = (*all + bytes, changed.max(*last));
    };
    for entry in memory::files("nearl.") {
        let file = entry.file_name().to_string_lossy().into_owned();
        let name = file.strip_prefix("nearl.").and_then(|rest| rest.split_once('.')).map(|(name, _)| name);
        if let (Some(name), Ok(meta)) = (name, entry.metadata()) {
            add(name, 512 * meta.blocks(), meta.mtime());
        }
    }
    for (entry, _) in home::own_entries(&home::of_user()) {
        let name = entry.file_name().to_string_lossy().into_owned();
        let Ok(robot) = RobotName::new(&name) else { continue };
        if home::has_files(&robot) || home::is_held(&robot) {
            add(&name, 0, 0);
            let files = home::own_entries(&entry.path());
            files.filter(|(_, m)| m.is_file()).for_each(|(_, m)| add(&name, 512 * m.blocks(), m.mtime()));
        }
    }
    found.into_iter().filter_map(|(name, (bytes, changed))| of(&name, bytes, changed)).collect()
}

fn of(name: &str, bytes: u64, changed: i64) -> Option<Remains> {
    let robot = RobotName::new(name).ok()?;
    let mut remains =
        Remains { name: name.to_owned(), alive: 0, dead: 0, bytes, held: home::is_held(&robot), changed };
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
