//! Where the links of a robot live: one folder per user, closed to everybody else, with a folder for each robot in it.
//!
//! ```text
//! /dev/shm/nearl-USER/           0700, ours, no link: whoever else owns it is refused by name before anything in it is opened
//!     ROBOT/                     the same
//!         alive                  locked together by every process that has links of the robot
//!         token                  the part of the segments' names that nobody can guess
//!         newest-*  owner-*      boards and roles
//!         nodes/  services/      iceoryx2's own
//! /dev/shm/nearl.ROBOT.TOKEN.*   iceoryx2's segments, which it can keep nowhere else
//! ```
//!
//! A process that comes while nobody holds `alive` begins anew: it removes what killed processes left before it opens anything, so that no start can
//! hang on a file that is half made. The process that leaves last removes everything.

use std::fs::{DirBuilder, DirEntry, File, Metadata, OpenOptions, read_dir, symlink_metadata};
use std::hash::{BuildHasher, Hasher};
use std::io::{Error, ErrorKind, Read, Result, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;

use super::memory::FOLDER;
use super::{LinkError, RobotName};

const ALIVE: &str = "alive";
const TOKEN: &str = "token";
/// Looks at a lock that another process holds while it begins or ends, and the pause between two.
const LOOKS: usize = 200;
const PAUSE: Duration = Duration::from_millis(10);

/// The folder of the calling user.
pub(crate) fn of_user() -> PathBuf {
    Path::new(FOLDER).join(format!("nearl-{}", rustix::process::geteuid().as_raw()))
}

/// A process's stay in the links of a robot.
#[derive(Debug)]
pub(crate) struct Home {
    folder: PathBuf,
    name: RobotName,
    alive: File,
}

impl Home {
    /// Makes and checks the folders, removes what nobody alive holds, and stays until it is dropped.
    ///
    /// # Errors
    /// [`LinkError::Foreign`] with the path that is not ours, or not what it should be; [`LinkError::Transport`].
    pub(crate) fn enter(name: &RobotName) -> std::result::Result<Home, LinkError> {
        let folder = name.folder();
        for part in [&of_user(), &folder] {
            own_folder(part).map_err(|e| foreign(name, part, &e))?;
        }
        let path = folder.join(ALIVE);
        for _ in 0..LOOKS {
            let alive = own_file(&path, true).map_err(|e| foreign(name, &path, &e))?;
            if flock(&alive, FlockOperation::NonBlockingLockExclusive).is_ok() && is_named(&alive, &path) {
                clear(name, &folder);
                write_token(&folder).map_err(|e| foreign(name, &folder.join(TOKEN), &e))?;
            }
            // Between the two locks another one may begin anew; nothing of ours is there yet.
            match flock(&alive, FlockOperation::NonBlockingLockShared) {
                Ok(()) if is_named(&alive, &path) && name.token().is_some() => {
                    return Ok(Home { folder, name: name.clone(), alive });
                }
                Ok(()) | Err(Errno::WOULDBLOCK) => std::thread::sleep(PAUSE),
                Err(e) => return Err(name.transport(format!("lock {}", path.display()), e.to_string())),
            }
        }
        let reason = "another process holds it while it begins or ends".to_owned();
        Err(name.transport(format!("lock {}", path.display()), reason))
    }
}

impl Drop for Home {
    fn drop(&mut self) {
        // The last one out. Whoever is refused the lock leaves the rest to those who hold it.
        let is_last = flock(&self.alive, FlockOperation::NonBlockingLockExclusive).is_ok();
        if is_last && is_named(&self.alive, &self.folder.join(ALIVE)) {
            clear(&self.name, &self.folder);
        }
    }
}

/// True if a process has links of the robot now.
pub(super) fn is_held(name: &RobotName) -> bool {
    let Ok(alive) = own_file(&name.folder().join(ALIVE), false) else { return false };
    flock(&alive, FlockOperation::NonBlockingLockExclusive) == Err(Errno::WOULDBLOCK)
}

/// True if the robot's folder holds more of this user's than its lock.
pub(super) fn has_files(name: &RobotName) -> bool {
    own_entries(&name.folder()).any(|(entry, _)| entry.file_name() != ALIVE)
}

/// What lies in a folder of this user and is this user's; nothing where the folder is not, or a link.
pub(super) fn own_entries(folder: &Path) -> impl Iterator<Item = (DirEntry, Metadata)> + use<> {
    let is_own = symlink_metadata(folder).is_ok_and(|meta| meta.is_dir() && is_ours(&meta));
    let entries = is_own.then(|| read_dir(folder).ok()).flatten().into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.metadata().ok().filter(is_ours).map(|meta| (entry, meta)))
}

/// True if it belongs to the calling user.
pub(super) fn is_ours(meta: &Metadata) -> bool {
    meta.uid() == rustix::process::geteuid().as_raw()
}

/// Everything of the robot but the lock itself.
fn clear(name: &RobotName, folder: &Path) {
    super::memory::remove_segments(name);
    for entry in read_dir(folder).into_iter().flatten().flatten().filter(|e| e.file_name() != ALIVE) {
        let path = entry.path();
        // Neither follows a link.
        let _ = if entry.file_type().is_ok_and(|t| t.is_dir()) {
            std::fs::remove_dir_all(path)
        } else {
            std::fs::remove_file(path)
        };
    }
}

/// A word that other users cannot guess: the keys of a hash are drawn by the system.
fn write_token(folder: &Path) -> Result<()> {
    let word = std::hash::RandomState::new().build_hasher().finish();
    let mut options = private();
    let mut file = options.write(true).create_new(true).open(folder.join(TOKEN))?;
    write!(file, "{word:016x}")
}

/// The token that `folder` holds.
pub(super) fn read_token(folder: &Path) -> Option<String> {
    let mut token = String::new();
    own_file(&folder.join(TOKEN), false).ok()?.take(64).read_to_string(&mut token).ok()?;
    (token.len() == 16 && token.bytes().all(|b| b.is_ascii_hexdigit())).then_some(token)
}

/// Options that neither follow a link nor wait for the other end of a pipe.
pub(super) fn private() -> OpenOptions {
    let mut options = OpenOptions::new();
    options.mode(0o600).custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY).bits() as i32);
    options
}

/// Opens a regular file of this user that nobody else may open, and makes it if `create`.
///
/// # Errors
/// What the system said; what the file is, where it is not that.
pub(super) fn own_file(path: &Path, create: bool) -> Result<File> {
    let odd = |meta: &Metadata| fault(meta, meta.is_file() && meta.nlink() == 1, "a regular file");
    // Asked before it is opened: to open a device may already do something.
    match symlink_metadata(path) {
        Ok(meta) => odd(&meta)?,
        Err(e) if e.kind() == ErrorKind::NotFound && create => {}
        Err(e) => return Err(e),
    }
    let file = private().read(true).write(true).create(create).open(path)?;
    odd(&file.metadata()?)?;
    Ok(file)
}

/// Makes a folder that only this user may enter, or checks that it is one.
fn own_folder(path: &Path) -> Result<()> {
    match DirBuilder::new().mode(0o700).create(path) {
        Err(e) if e.kind() != ErrorKind::AlreadyExists => return Err(e),
        _ => {}
    }
    let meta = symlink_metadata(path)?;
    fault(&meta, meta.is_dir(), "a folder")
}

fn fault(meta: &Metadata, is_right: bool, kind: &str) -> Result<()> {
    let user = rustix::process::geteuid().as_raw();
    let text = if !is_right {
        format!("it is not {kind} with one name")
    } else if meta.uid() != user {
        format!("it belongs to user {}, not to {user}", meta.uid())
    } else if meta.mode() & 0o077 != 0 {
        format!("others may use it (mode {:o})", meta.mode() & 0o777)
    } else {
        return Ok(());
    };
    Err(Error::other(text))
}

fn is_named(file: &File, path: &Path) -> bool {
    let same = |a: &Metadata, b: &Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    matches!((file.metadata(), symlink_metadata(path)), (Ok(a), Ok(b)) if same(&a, &b))
}

pub(super) fn foreign(name: &RobotName, path: &Path, error: &Error) -> LinkError {
    match error.raw_os_error() {
        // Too little or no memory is what the links' own check says, in its own words.
        Some(code) if Errno::from_raw_os_error(code) == Errno::ROFS => {
            LinkError::MemoryMissing { name: name.clone(), path: FOLDER, reason: error.to_string() }
        }
        _ => LinkError::Foreign {
            name: name.clone(),
            path: path.display().to_string(),
            reason: error.to_string(),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    fn name(what: &str) -> RobotName {
        RobotName::new(&format!("t{}-{what}", std::process::id())).unwrap()
    }

    #[test]
    fn the_last_one_out_and_the_first_one_in_clear_up() {
        let name = name("home");
        let first = Home::enter(&name).unwrap();
        let token = name.token().unwrap();
        let second = Home::enter(&name).unwrap();
        assert_eq!(name.token().unwrap(), token, "they share the names");
        drop(first);
        assert!(is_held(&name) && has_files(&name));
        drop(second);
        assert!(!is_held(&name) && !has_files(&name));
        // What a killed process left, half made.
        std::fs::create_dir_all(name.folder().join("nodes/7")).unwrap();
        std::fs::write(name.folder().join("newest-state"), "half").unwrap();
        std::fs::write(Path::new(FOLDER).join(format!("{}0.data", name.prefix())), "half").unwrap();
        let third = Home::enter(&name).unwrap();
        assert_ne!(name.token().unwrap(), token);
        let left: Vec<_> = read_dir(name.folder()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left.len(), 2, "{left:?}");
        assert!(!Path::new(FOLDER).join(format!("{}0.data", name.prefix())).exists());
        drop(third);
        super::super::remove_files(&name);
    }

    #[test]
    fn what_is_not_ours_or_not_a_file_is_refused_by_name() {
        let name = name("odd");
        drop(Home::enter(&name).unwrap());
        let (folder, alive) = (name.folder(), name.folder().join(ALIVE));
        let refused = |words: &[&str]| {
            let error = Home::enter(&name).unwrap_err();
            assert_eq!(error.code(), "link-foreign", "{error}");
            words
                .iter()
                .for_each(|word| assert!(error.to_string().contains(word), "'{word}' is not in: {error}"));
        };
        std::fs::set_permissions(&alive, PermissionsExt::from_mode(0o666)).unwrap();
        refused(&["alive", "666"]);
        std::fs::remove_file(&alive).unwrap();
        symlink("/etc/passwd", &alive).unwrap();
        refused(&["alive", "not a regular file"]);
        std::fs::remove_file(&alive).unwrap();
        rustix::fs::mknodat(rustix::fs::CWD, &alive, rustix::fs::FileType::Fifo, 0o600.into(), 0).unwrap();
        refused(&["alive", "not a regular file"]);
        std::fs::remove_file(&alive).unwrap();
        std::fs::set_permissions(&folder, PermissionsExt::from_mode(0o755)).unwrap();
        refused(&[name.as_str(), "755"]);
        std::fs::remove_dir_all(&folder).unwrap();
        symlink("/tmp", &folder).unwrap();
        refused(&[name.as_str(), "not a folder"]);
        std::fs::remove_file(&folder).unwrap();
    }
}
