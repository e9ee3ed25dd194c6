//! What robots have in shared memory now, and whether a living process still holds it.

use std::collections::BTreeMap;
use std::fs::read_dir;
use std::os::unix::fs::MetadataExt;

use iceoryx2::prelude::{CallbackProgression, Node, NodeState};

use super::RobotName;
use super::memory::FOLDER;
use super::service::Ipc;

/// Shared memory of one robot name.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Remains {
    /// Robot.
    pub name: String,
    /// Processes that hold it; those of other users count as living.
    pub alive: usize,
    /// Processes that died without leaving.
    pub dead: usize,
    /// Memory taken [bytes].
    pub bytes: u64,
}

impl Remains {
    /// True if nobody but dead processes holds it.
    pub fn is_stale(&self) -> bool {
        self.alive == 0 && self.dead > 0
    }
}

/// Every robot name with shared memory on this machine, sorted by name.
pub fn remains() -> Vec<Remains> {
    let mut sizes: BTreeMap<String, u64> = BTreeMap::new();
    for entry in read_dir(FOLDER).into_iter().flatten().flatten() {
        let file = entry.file_name().to_string_lossy().into_owned();
        let name = file.strip_prefix("nearl.").and_then(|rest| rest.split_once('.')).map(|(name, _)| name);
        if let (Some(name), Ok(meta)) = (name, entry.metadata()) {
            *sizes.entry(name.to_owned()).or_default() += 512 * meta.blocks();
        }
    }
    sizes.into_iter().filter_map(|(name, bytes)| of(&name, bytes)).collect()
}

fn of(name: &str, bytes: u64) -> Option<Remains> {
    let config = RobotName::new(name).ok()?.config().ok()?;
    let mut remains = Remains { name: name.to_owned(), alive: 0, dead: 0, bytes };
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
