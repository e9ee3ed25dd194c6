//! Reads files whose size and kind are not to be trusted.

use std::fs::{File, OpenOptions};
use std::io::{Error, Read, Result};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Largest robot or fault file that is read \[bytes\].
pub const MAX_TEXT_BYTES: u64 = 16 << 20;

/// Largest task, recipe or limits file that is read, before it is parsed \[bytes\].
pub const MAX_TASK_BYTES: u64 = 1 << 20;

/// Opens a regular file for reading, without ever waiting: a pipe, a device or a folder is refused, whatever it would do when read.
/// With `links`, the last part of the path may be a symbolic link.
///
/// # Errors
/// What the system said, or what the path is instead of a file.
pub fn open_regular(path: &Path, links: bool) -> Result<File> {
    // Looked at before it is opened too: to open some devices already does something.
    let named = if links { std::fs::metadata(path)? } else { std::fs::symlink_metadata(path)? };
    let odd = || Error::other("it is not a regular file");
    if named.is_dir() {
        return Err(Error::other("it is a directory, not a regular file"));
    }
    if !named.is_file() {
        return Err(odd());
    }
    let at_the_link = if links { 0 } else { libc::O_NOFOLLOW };
    let flags = libc::O_NONBLOCK | libc::O_NOCTTY | at_the_link;
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    if file.metadata()?.is_file() { Ok(file) } else { Err(odd()) }
}

/// The content of a regular file of at most `limit` bytes; what grows while it is read is cut off by the same limit.
///
/// # Errors
/// As [`open_regular`]; a file that is larger.
pub fn read_bounded(path: &Path, limit: u64, links: bool) -> Result<Vec<u8>> {
    let file = open_regular(path, links)?;
    let length = file.metadata()?.len();
    let too_large = |length| Error::other(format!("it has {length} bytes, more than the limit of {limit}"));
    if length > limit {
        return Err(too_large(length));
    }
    let mut bytes = Vec::with_capacity(length as usize);
    let read = file.take(limit + 1).read_to_end(&mut bytes)? as u64;
    if read > limit { Err(too_large(read)) } else { Ok(bytes) }
}

/// The text of a regular file of at most [`MAX_TEXT_BYTES`].
///
/// # Errors
/// As [`read_bounded`]; a file that is not UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    text(path, MAX_TEXT_BYTES)
}

/// The text of a regular file of at most [`MAX_TASK_BYTES`].
///
/// # Errors
/// As [`read_text`].
pub fn read_task_text(path: &Path) -> Result<String> {
    text(path, MAX_TASK_BYTES)
}

fn text(path: &Path, limit: u64) -> Result<String> {
    let bytes = read_bounded(path, limit, true)?;
    String::from_utf8(bytes).map_err(|e| Error::other(format!("it is not UTF-8 text: {}", e.utf8_error())))
}
