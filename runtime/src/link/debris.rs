//! Removes what a process left that was killed while it joined, or while another removed what it had left.
//!
//! Each node of iceoryx2 0.10 has two files: its details, which say where its other files are, and its monitor, by which others see
//! that its process is dead. A node that is made writes the details before the monitor, and one that is removed loses the details
//! before the monitor. So a process killed between the two leaves a node without a monitor, which no clean-up finds, or without
//! details, which none can finish. A process killed while it created a service leaves the service's description unfinished, and
//! whoever comes later waits for it in vain.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs::{Metadata, read_dir, read_link, read_to_string, remove_dir_all, remove_file};
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::{RobotName, memory};

/// What is half a node before and after this pause is not one that is being made or removed; both take milliseconds. Only a start
/// that finds one waits.
const PAUSE: Duration = Duration::from_millis(100);
/// The files that monitor a node, after the name's prefix and the node's number.
const MONITOR: [&str; 3] = [".node_monitor", ".node_monitor_owner_lock", ".node_monitor_context"];

/// Removes the halves of nodes of processes that are gone.
pub(super) fn sweep(name: &RobotName) {
    sweep_folder(&name.folder().join("nodes"), &name.segments());
}

fn sweep_folder(nodes: &Path, prefix: &str) {
    let before = halves(nodes, prefix);
    if before.is_empty() {
        return;
    }
    std::thread::sleep(PAUSE);
    for node in before.intersection(&halves(nodes, prefix)) {
        // Another process may be faster: what it left is removed all the same.
        let _ = remove_dir_all(nodes.join(node.to_string()));
        for file in MONITOR {
            let _ = remove_file(nodes.join(format!("{prefix}{node}{file}")));
        }
    }
}

/// Removes segments that were begun and that nobody finishes any more: until they are, only their owner may write them and nobody may read
/// them, and whoever makes one has it open. Whoever opens the ports of the dead would wait for them, so this comes before a node is made.
pub(super) fn sweep_segments(name: &RobotName) {
    let before = begun(name);
    if before.is_empty() {
        return;
    }
    std::thread::sleep(PAUSE);
    for (file, _) in before.intersection(&begun(name)).filter(|(file, _)| !is_open(file)) {
        let _ = remove_file(file);
    }
}

/// True if a process has the file open. A process of this user that cannot be looked into, as one with rights of its own, may have it. On a
/// machine with more to do than it can, a living process is kept from going on for longer than any pause; without its segment, what is sent to it
/// would go nowhere.
fn is_open(file: &Path) -> bool {
    let has = |process: PathBuf| match read_dir(process.join("fd")) {
        Ok(open) => open.flatten().any(|fd| read_link(fd.path()).is_ok_and(|to| to == file)),
        Err(e) => e.kind() == ErrorKind::PermissionDenied && is_of_this_user(&process),
    };
    read_dir("/proc").into_iter().flatten().flatten().any(|process| has(process.path()))
}

/// True if this user started the process: the first of its users.
fn is_of_this_user(process: &Path) -> bool {
    let status = read_to_string(process.join("status")).unwrap_or_default();
    let users = status.lines().find_map(|line| line.strip_prefix("Uid:"));
    let first = users.and_then(|all| all.split_whitespace().next()?.parse().ok());
    first == Some(rustix::process::getuid().as_raw())
}

fn begun(name: &RobotName) -> BTreeSet<(PathBuf, u64)> {
    let is_begun = |meta: &Metadata| meta.is_file() && meta.mode() & 0o777 == 0o200;
    let segments = name.segments();
    memory::files(&segments)
        .filter_map(|f| f.metadata().ok().filter(is_begun).map(|meta| (f.path(), meta.ino())))
        .collect()
}

/// Finishing the description of a service takes milliseconds: one that is unfinished for so long was left, if nobody has it open.
const LEFT: Duration = Duration::from_secs(1);

/// Descriptions of services that are not finished: they become readable only, to the owner, when they are.
pub(super) struct Unfinished {
    files: BTreeSet<(PathBuf, u64)>,
    since: Instant,
}

impl Unfinished {
    pub(super) fn of(name: &RobotName) -> Unfinished {
        let files = read_dir(name.folder().join("services")).into_iter().flatten().flatten();
        let half = files.filter_map(|f| {
            let meta = f.metadata().ok()?;
            (meta.is_file() && meta.mode() & 0o777 == 0o600).then(|| (f.path(), meta.ino()))
        });
        Unfinished { files: half.collect(), since: Instant::now() }
    }

    /// Removes those that still are, once they had the time to be finished.
    pub(super) fn remove_left(&self, name: &RobotName) {
        if self.files.is_empty() || self.since.elapsed() < LEFT {
            return;
        }
        let still = Unfinished::of(name).files;
        for (file, _) in self.files.intersection(&still).filter(|(file, _)| !is_open(file)) {
            // Another process may be faster.
            let _ = remove_file(file);
        }
    }
}

/// Nodes of processes that are gone, without details or without a monitor.
fn halves(nodes: &Path, prefix: &str) -> BTreeSet<u128> {
    let names: BTreeSet<OsString> =
        read_dir(nodes).into_iter().flatten().flatten().map(|e| e.file_name()).collect();
    let whole = |node: u128| {
        names.contains(&OsString::from(format!("{prefix}{node}{}", MONITOR[0])))
            && nodes.join(node.to_string()).join(format!("{prefix}node.details")).exists()
    };
    let numbers = names.iter().filter_map(|name| name.to_str()?.parse::<u128>().ok());
    numbers.filter(|&node| !whole(node) && is_gone(node)).collect()
}

/// True if the process that made the node no longer exists: its number is in the node's.
fn is_gone(node: u128) -> bool {
    let process = (node >> 64) as u32;
    !Path::new("/proc").join(process.to_string()).exists()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{OpenOptions, create_dir_all, write};
    use std::os::unix::fs::OpenOptionsExt;

    const PREFIX: &str = "nearl.debris.";

    /// A node with these of its files.
    fn node(nodes: &Path, process: u32, details: bool, monitor: bool) -> String {
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
        number
    }

    /// However long the one who makes it takes.
    #[test]
    fn a_segment_that_is_being_made_stays() {
        let name = RobotName::new(&format!("t{}-begun", std::process::id())).unwrap();
        let home = super::super::home::Home::enter(&name).unwrap();
        let segment = Path::new(memory::FOLDER).join(format!("{}1_2.connection", name.segments()));
        let maker = OpenOptions::new().write(true).create_new(true).mode(0o200).open(&segment).unwrap();
        sweep_segments(&name);
        assert!(segment.exists(), "{} was taken from the one who makes it", segment.display());
        drop(maker);
        // A process that another test starts may have it for a moment.
        (0..10).take_while(|_| segment.exists()).for_each(|_| sweep_segments(&name));
        assert!(!segment.exists(), "{} was left", segment.display());
        drop(home);
        super::super::remove_files(&name);
    }

    #[test]
    fn only_halves_of_dead_processes_go() {
        let nodes = std::env::temp_dir().join(format!("nearl-debris-{}", std::process::id()));
        let (dead, alive) = (u32::MAX >> 1, std::process::id());
        let gone = [node(&nodes, dead, true, false), node(&nodes, dead - 1, false, true)];
        let kept = [node(&nodes, dead - 2, true, true), node(&nodes, alive, true, false)];
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
