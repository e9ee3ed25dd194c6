//! The single owner of a role: whoever holds a lock on a file beside the robot's segments. The system lets go of it when the
//! process ends, however it ends, so that a killed owner never stands in the way of the next one.

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use super::{LinkError, RobotName, home};

/// Holds a role of a robot until it is dropped.
#[derive(Debug)]
pub struct Owner {
    path: PathBuf,
    _lock: File,
}

impl Owner {
    /// Whether somebody has the `role`, or had it and was killed.
    pub(crate) fn is_taken(name: &RobotName, role: &str) -> bool {
        name.folder().join(format!("owner-{role}")).exists()
    }

    /// Takes the `role` (`plant`, `runtime`, `trainer`).
    ///
    /// # Errors
    /// [`LinkError::Taken`] when another process, or another link of this one, has it.
    pub(crate) fn take(name: &RobotName, role: &'static str) -> Result<Owner, LinkError> {
        let path = name.folder().join(format!("owner-{role}"));
        let failed = |e: std::io::Error| name.transport(format!("lock {}", path.display()), e.to_string());
        loop {
            let file = home::own_file(&path, true).map_err(|e| home::foreign(name, &path, &e))?;
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Err(Errno::WOULDBLOCK) => return Err(LinkError::Taken { name: name.clone(), role }),
                Err(e) => return Err(failed(e.into())),
                Ok(()) => {}
            }
            // The last owner may have removed the file between opening and locking: then another one has its name.
            let mine = file.metadata().map_err(failed)?;
            if std::fs::metadata(&path)
                .is_ok_and(|named| (named.dev(), named.ino()) == (mine.dev(), mine.ino()))
            {
                return Ok(Owner { path, _lock: file });
            }
        }
    }
}

impl Drop for Owner {
    fn drop(&mut self) {
        // Still locked: whoever opens it now sees that its name is gone and tries again.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU32, Ordering};

    #[test]
    fn a_role_has_one_owner_at_a_time() {
        let name = RobotName::new(&format!("t{}-owner", std::process::id())).unwrap();
        let home = home::Home::enter(&name).unwrap();
        let first = Owner::take(&name, "plant").unwrap();
        let taken = LinkError::Taken { name: name.clone(), role: "plant" };
        assert_eq!(Owner::take(&name, "plant").unwrap_err(), taken);
        let other = Owner::take(&name, "runtime").unwrap();
        drop(first);
        drop(Owner::take(&name, "plant").unwrap());
        drop(other);
        assert!(!name.folder().join("owner-plant").exists(), "the file goes with its owner");
        drop(home);
        super::super::remove_files(&name);
    }

    #[test]
    fn a_crowd_never_owns_a_role_together() {
        let name = RobotName::new(&format!("t{}-crowd", std::process::id())).unwrap();
        let _home = home::Home::enter(&name).unwrap();
        let (inside, owned) = (AtomicU32::new(0), AtomicU32::new(0));
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    while owned.load(Ordering::SeqCst) < 2000 {
                        let Ok(owner) = Owner::take(&name, "trainer") else { continue };
                        assert_eq!(inside.fetch_add(1, Ordering::SeqCst), 0, "two owners");
                        owned.fetch_add(1, Ordering::SeqCst);
                        inside.fetch_sub(1, Ordering::SeqCst);
                        drop(owner);
                    }
                });
            }
        });
    }
}
