//! The C interface: `include/nearl.h`, which a test compares with what is defined here.
//!
//! No panic leaves this library: a call in which something panics returns what it returns when it fails.

mod controller;
mod plant;
mod proposer;

use std::ffi::{CStr, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

pub use controller::{
    Ledger, Sizes, nearl_controller_free, nearl_controller_load, nearl_controller_reset,
    nearl_controller_sizes, nearl_controller_update, nearl_status_name,
};
pub use plant::{RobotIn, StateIn, nearl_plant_close, nearl_plant_exchange, nearl_plant_open};
pub use proposer::{
    nearl_proposer_close, nearl_proposer_entries, nearl_proposer_entry, nearl_proposer_is_action,
    nearl_proposer_open, nearl_proposer_propose, nearl_proposer_state,
};

/// What a call with a null pointer, or one that panicked, returns.
const REFUSED: c_int = -1;

/// Version of the library.
#[unsafe(no_mangle)]
pub extern "C" fn nearl_version() -> *const c_char {
    concat!(env!("CARGO_PKG_VERSION"), "\0").as_ptr().cast()
}

/// Runs `f`; a panic becomes `otherwise`.
fn guarded<T>(otherwise: T, f: impl FnOnce() -> T) -> T {
    catch_unwind(AssertUnwindSafe(f)).unwrap_or(otherwise)
}

/// How long to wait for something: days for infinity, not at all below 0; `None` of what is no number.
fn waiting(seconds: f64) -> Option<Duration> {
    (!seconds.is_nan()).then(|| Duration::from_secs_f64(seconds.clamp(0.0, 1e6)))
}

/// A C string.
///
/// # Safety
/// `text` is null or ends with a zero.
unsafe fn text(what: &str, text: *const c_char) -> Result<String, String> {
    if text.is_null() {
        return Err(format!("{what} is NULL"));
    }
    // SAFETY: by contract.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map(str::to_string).map_err(|_| format!("{what} is not UTF-8"))
}

/// A C array; `NULL` is empty where its length is 0.
///
/// # Safety
/// `start` points to `n` values that stay while the slice is used.
unsafe fn slice<'a, T>(start: *const T, n: usize) -> Option<&'a [T]> {
    match n {
        0 => Some(&[]),
        _ if start.is_null() => None,
        // SAFETY: by contract.
        _ => Some(unsafe { std::slice::from_raw_parts(start, n) }),
    }
}

/// Writes one sentence, cut to what fits.
///
/// # Safety
/// `error` is null or has room for `size` bytes.
unsafe fn say(error: *mut c_char, size: usize, sentence: &str) {
    if error.is_null() || size == 0 {
        return;
    }
    let mut n = sentence.len().min(size - 1);
    while !sentence.is_char_boundary(n) {
        n -= 1;
    }
    // SAFETY: `n + 1 <= size`.
    unsafe {
        std::ptr::copy_nonoverlapping(sentence.as_ptr().cast(), error, n);
        *error.add(n) = 0;
    }
}

/// A handle for the value, or null with the sentence.
///
/// # Safety
/// As [`say`].
unsafe fn handle<T>(made: Result<T, String>, error: *mut c_char, size: usize) -> *mut T {
    match made {
        Ok(value) => Box::into_raw(Box::new(value)),
        Err(sentence) => {
            // SAFETY: by contract.
            unsafe { say(error, size, &sentence) };
            std::ptr::null_mut()
        }
    }
}
