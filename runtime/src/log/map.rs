//! A file as memory, so that a log larger than memory can be read.

use std::fs::File;
use std::io;
use std::path::Path;
use std::ptr;

use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

/// A file mapped for reading. Its owner must not cut it short meanwhile.
pub(super) struct Map {
    start: *mut std::ffi::c_void,
    length: usize,
}

impl Map {
    pub(super) fn open(path: &Path) -> io::Result<Map> {
        let meta = std::fs::metadata(path)?;
        if !meta.is_file() {
            return Err(io::Error::other("it is not a regular file"));
        }
        let file = File::open(path)?;
        let length = file.metadata()?.len() as usize;
        if length == 0 {
            return Err(io::Error::other("it is empty"));
        }
        // SAFETY: a new private mapping at an address of the system's choice; nothing else refers to it.
        let start = unsafe { mmap(ptr::null_mut(), length, ProtFlags::READ, MapFlags::PRIVATE, &file, 0) }?;
        Ok(Map { start, length })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        // SAFETY: the mapping has this length and lives as long as `self`.
        unsafe { std::slice::from_raw_parts(self.start.cast(), self.length) }
    }
}

impl Drop for Map {
    fn drop(&mut self) {
        // SAFETY: the mapping made in `open`, which nothing refers to any more.
        let _ = unsafe { munmap(self.start, self.length) };
    }
}
