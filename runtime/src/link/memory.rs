//! Shared memory is checked and reserved before the first message: a full tmpfs otherwise kills the writer with SIGBUS.

use std::fs::{DirEntry, Metadata, OpenOptions, read_dir};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};

use rustix::fs::{FallocateFlags, fallocate, statvfs};
use rustix::io::Errno;

use super::{LinkError, RobotName, home};

pub(crate) const FOLDER: &str = "/dev/shm";
const MEGABYTE: u64 = 1 << 20;

/// Checks that `bytes` can really be written to shared memory: free blocks first, then a reserved probe file.
pub(crate) fn check(name: &RobotName, bytes: u64) -> Result<(), LinkError> {
    let missing = |reason: String| LinkError::MemoryMissing { name: name.clone(), path: FOLDER, reason };
    let space = statvfs(FOLDER).map_err(|e| missing(e.to_string()))?;
    let available = space.f_bavail * space.f_frsize;
    if available < bytes {
        return Err(too_small(name, available, bytes));
    }
    // Without a name: whoever is killed here leaves nothing.
    let probe = OpenOptions::new().write(true).custom_flags(libc::O_TMPFILE).mode(0o600).open(FOLDER);
    let probe = probe.map_err(|e| missing(e.to_string()))?;
    fallocate(&probe, FallocateFlags::empty(), 0, bytes).map_err(|e| match e {
        Errno::NOSPC => too_small(name, available, bytes),
        other => missing(other.to_string()),
    })
}

/// Free shared memory [bytes]; 0 if there is none.
pub(crate) fn free() -> u64 {
    statvfs(FOLDER).map_or(0, |space| space.f_bavail * space.f_frsize)
}

pub(super) fn too_small(name: &RobotName, available: u64, bytes: u64) -> LinkError {
    let (available, needed) = (available / MEGABYTE, bytes.div_ceil(MEGABYTE));
    LinkError::Memory { name: name.clone(), path: FOLDER, available, needed }
}

/// Every file of this user in shared memory whose name begins with `prefix`. What others call so is left alone, by root too.
pub(super) fn files(prefix: &str) -> impl Iterator<Item = DirEntry> {
    let entries = read_dir(FOLDER).into_iter().flatten().flatten();
    let named = entries.filter(move |entry| entry.file_name().to_string_lossy().starts_with(prefix));
    named.filter(|entry| entry.metadata().is_ok_and(|meta| home::is_ours(&meta)))
}

/// Closes the segments of this robot to other users: iceoryx2 opens one of them, a counter, to all.
pub(super) fn close_to_others(name: &RobotName) {
    for entry in files(&name.segments()) {
        // Looked at again once it is open: its name may be another file's by now.
        let is_open = |meta: &Metadata| meta.is_file() && home::is_ours(meta) && meta.mode() & 0o077 != 0;
        if let Ok(file) = home::private().read(true).open(entry.path())
            && file.metadata().is_ok_and(|meta| is_open(&meta))
        {
            let _ = file.set_permissions(PermissionsExt::from_mode(0o600));
        }
    }
}

/// Reserves every page of the segments this robot has now, so that no later write meets a full tmpfs.
pub(crate) fn reserve(name: &RobotName) -> Result<(), LinkError> {
    for entry in files(&name.segments()) {
        // A segment may vanish or belong to a peer that is starting: only a full tmpfs matters here.
        let Ok(file) = home::private().write(true).open(entry.path()) else { continue };
        let Ok(meta) = file.metadata() else { continue };
        let length = if meta.is_file() && home::is_ours(&meta) { meta.len() } else { 0 };
        if length > 0 && fallocate(&file, FallocateFlags::KEEP_SIZE, 0, length) == Err(Errno::NOSPC) {
            return Err(too_small(name, 0, length));
        }
    }
    Ok(())
}

/// Removes what a robot name left behind. Only for names no process uses any more (tests, demonstrations, benchmarks).
pub fn remove_files(name: &RobotName) {
    remove_segments(name);
    if let Some((folder, _)) =
        home::own_entries(&home::of_user()).find(|(entry, _)| entry.file_name() == name.as_str())
    {
        let _ = std::fs::remove_dir_all(folder.path());
    }
}

/// Removes iceoryx2's segments of a robot name; those of other users stay.
pub(super) fn remove_segments(name: &RobotName) {
    for entry in files(&name.prefix()) {
        let _ = std::fs::remove_file(entry.path());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_the_tmpfs_holds_is_refused_with_both_numbers() {
        let name = RobotName::new("memory-check").unwrap();
        check(&name, MEGABYTE).unwrap();
        let error = check(&name, 1 << 60).unwrap_err();
        assert!(matches!(error, LinkError::Memory { needed, .. } if needed == 1 << 40), "{error}");
    }
}
