//! What a process left that was killed while it joined or while it was cleaned up after.
//!
//! iceoryx2 0.10 finds dead processes by the monitor file of their node, and reads where the node keeps its files from its
//! details. The details come first and go first, so one killed in between leaves a node without a monitor or without details,
//! which no clean-up finds or finishes.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{read_dir, remove_dir_all, remove_file};
use std::path::Path;
use std::time::Duration;

use super::RobotName;

/// Age from which half a node is no longer one that is being made or removed; both take milliseconds.
const AGE: Duration = Duration::from_secs(10);
/// The files that monitor a node, after the name's prefix and the node's number.
const MONITOR: [&str; 3] = [".node_monitor", ".node_monitor_owner_lock", ".node_monitor_context"];

/// Removes the halves of nodes of processes that are gone.
pub(super) fn sweep(name: &RobotName) {
    sweep_folder(&name.folder().join("nodes"), &name.prefix());
}

fn sweep_folder(nodes: &Path, prefix: &str) {
    let names: BTreeSet<OsString> =
        read_dir(nodes).into_iter().flatten().flatten().map(|e| e.file_name()).collect();
    for name in &names {
        let Some(node) = name.to_str().and_then(|n| n.parse::<u128>().ok()) else { continue };
        let folder = nodes.join(name);
        let monitored = names.contains(&OsString::from(format!("{prefix}{node}{}", MONITOR[0])));
        let whole = monitored && folder.join(format!("{prefix}node.details")).exists();
        if !whole && is_gone(node) && is_old(&folder) {
            // Another process may be faster: what it left is removed all the same.
            let _ = remove_dir_all(&folder);
            for file in MONITOR {
                let _ = remove_file(nodes.join(format!("{prefix}{node}{file}")));
            }
        }
    }
}

/// True if the process that made the node no longer exists: its number is in the node's.
fn is_gone(node: u128) -> bool {
    let process = (node >> 64) as u32;
    !Path::new("/proc").join(process.to_string()).exists()
}

fn is_old(folder: &Path) -> bool {
    let changed = folder.metadata().and_then(|m| m.modified());
    changed.is_ok_and(|time| time.elapsed().is_ok_and(|age| age > AGE))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{File, create_dir_all, write};
    use std::time::SystemTime;

    const PREFIX: &str = "nearl.debris.";

    /// A node with these of its files, changed `age` ago.
    fn node(nodes: &Path, process: u32, details: bool, monitor: bool, age: Duration) -> String {
        let number = (u128::from(process) << 64 | 7).to_string();
        let folder = nodes.join(&number);
        create_dir_all(&folder).unwrap();
        write(folder.join("half.port_tag"), "").unwrap();
        if details {
            write(folder.join(format!("{PREFIX}node.details")), "").unwrap();
        }
        if monitor {
            MONITOR.iter().for_each(|m| write(nodes.join(format!("{PREFIX}{number}{m}")), "").unwrap());
        }
        File::open(&folder).unwrap().set_modified(SystemTime::now() - age).unwrap();
        number
    }

    #[test]
    fn only_old_halves_of_dead_processes_go() {
        let nodes = std::env::temp_dir().join(format!("nearl-debris-{}", std::process::id()));
        let old = Duration::from_secs(60);
        let (dead, alive) = (u32::MAX >> 1, std::process::id());
        let gone = [node(&nodes, dead, true, false, old), node(&nodes, dead - 1, false, true, old)];
        let kept = [
            node(&nodes, dead - 2, true, true, old),
            node(&nodes, dead - 3, true, false, Duration::ZERO),
            node(&nodes, alive, true, false, old),
        ];
        sweep_folder(&nodes, PREFIX);
        let left: Vec<String> =
            read_dir(&nodes).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        std::fs::remove_dir_all(&nodes).unwrap();
        assert!(
            gone.iter().all(|number| !left.iter().any(|name| name.contains(number.as_str()))),
            "{left:?}"
        );
        assert!(kept.iter().all(|number| left.contains(number)), "{left:?}");
        assert_eq!(left.len(), kept.len() + MONITOR.len());
    }
}
