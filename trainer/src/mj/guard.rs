//! MuJoCo's messages: warnings are counted, fatal errors become a Rust error instead of the end of the process.
//!
//! A handler is set for the calling thread and only while a call of ours runs, so that another user of the same
//! library in the process (the `mujoco` Python package) keeps its own. On a fatal error the handler unwinds through
//! MuJoCo's C frames back to [`catching`]; the functions called there are declared `C-unwind` for that reason, and the
//! simulation must be reset afterwards, because MuJoCo was left in the middle of a computation.

use std::ffi::{CStr, CString, c_char, c_int};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use mujoco_rs::mujoco_c::{mj_deleteModel, mj_loadXML, mjData, mjModel};
use mujoco_rs::wrappers::mj_auxiliary::MjVfs;
use mujoco_rs::wrappers::mj_logging::{MjLogMessage, MjtLogLevel};

use super::MjError;

type Handler = unsafe extern "C-unwind" fn(*const MjLogMessage);

unsafe extern "C-unwind" {
    pub(super) fn mj_copyData(to: *mut mjData, m: *const mjModel, from: *const mjData) -> *mut mjData;
    pub(super) fn mj_setConst(m: *mut mjModel, d: *mut mjData);
    pub(super) fn mj_resetData(m: *const mjModel, d: *mut mjData);
    pub(super) fn mj_forward(m: *const mjModel, d: *mut mjData);
    pub(super) fn mj_inverse(m: *const mjModel, d: *mut mjData);
    pub(super) fn mj_step(m: *const mjModel, d: *mut mjData);
    pub(super) fn mj_kinematics(m: *const mjModel, d: *mut mjData);
    pub(super) fn mj_rnePostConstraint(m: *const mjModel, d: *mut mjData);
    // Exported for language bindings; returns the handler it replaces.
    fn _mjPRIVATE_setTlsLogHandler(handler: Option<Handler>) -> Option<Handler>;
}

static WARNINGS: AtomicU64 = AtomicU64::new(0);
static LAST_WARNING: Mutex<Option<String>> = Mutex::new(None);

/// Warnings MuJoCo gave since the process started, all threads together.
pub fn warnings() -> u64 {
    WARNINGS.load(Ordering::Relaxed)
}

/// Text of the latest warning.
pub fn last_warning() -> Option<String> {
    LAST_WARNING.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).clone()
}

/// A fatal error on its way from MuJoCo's C code to [`catching`].
struct Fatal(String);

/// Runs `call`, which may use the functions above; a fatal error of MuJoCo comes back as [`MjError::Engine`].
pub(super) fn catching(call: impl FnOnce()) -> Result<(), MjError> {
    let _installed = Installed::new(unwind_on_error);
    catch_unwind(AssertUnwindSafe(call)).map_err(|payload| match payload.downcast::<Fatal>() {
        Ok(fatal) => MjError::Engine(fatal.0),
        Err(other) => resume_unwind(other),
    })
}

/// Runs `call`, which may use MuJoCo through `mujoco-rs` (whose declarations cannot unwind), counting warnings.
pub(super) fn counting_warnings<R>(call: impl FnOnce() -> R) -> R {
    let _installed = Installed::new(abort_on_error);
    call()
}

/// Our handler for this thread, until dropped.
struct Installed(Option<Handler>);

impl Installed {
    fn new(handler: Handler) -> Installed {
        // SAFETY: the handler is a function of this module and thread-local in effect.
        Installed(unsafe { _mjPRIVATE_setTlsLogHandler(Some(handler)) })
    }
}

impl Drop for Installed {
    fn drop(&mut self) {
        // SAFETY: gives back what `new` was given by the same call.
        unsafe { _mjPRIVATE_setTlsLogHandler(self.0) };
    }
}

unsafe extern "C-unwind" fn unwind_on_error(message: *const MjLogMessage) {
    // SAFETY: MuJoCo passes a valid message for the length of this call.
    let message = unsafe { &*message };
    match message.level() {
        MjtLogLevel::mjLOG_ERROR => resume_unwind(Box::new(Fatal(text(message)))),
        MjtLogLevel::mjLOG_WARNING => count(message),
        _ => {}
    }
}

unsafe extern "C-unwind" fn abort_on_error(message: *const MjLogMessage) {
    // SAFETY: as above.
    let message = unsafe { &*message };
    match message.level() {
        MjtLogLevel::mjLOG_ERROR => {
            eprintln!("MuJoCo stopped with an error it cannot return from: {}", text(message));
            std::process::abort();
        }
        MjtLogLevel::mjLOG_WARNING => count(message),
        _ => {}
    }
}

fn count(message: &MjLogMessage) {
    WARNINGS.fetch_add(1, Ordering::Relaxed);
    *LAST_WARNING.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(text(message));
}

fn text(message: &MjLogMessage) -> String {
    let subject = one_line(message.subject());
    match message.func() {
        Some(function) if !function.is_empty() => format!("{function}: {subject}"),
        _ => subject,
    }
}

/// Bytes of an explanation that `mujoco-rs` hands on.
const HANDED_ON: usize = 99;
/// Bytes of the longest explanation that MuJoCo writes.
const MOST: usize = 1024;

/// Why MuJoCo does not load the file `path` of `files`; `said` is as much as `mujoco-rs` hands on. Where that may be less than all, MuJoCo is asked
/// again.
pub(super) fn refused(path: &Path, files: &MjVfs, said: &str) -> MjError {
    let whole = if said.len() < HANDED_ON { None } else { explanation(path, files) };
    MjError::Load(one_line(whole.as_deref().unwrap_or(said)))
}

fn explanation(path: &Path, files: &MjVfs) -> Option<String> {
    let path = CString::new(path.to_str()?).ok()?;
    let mut room: [c_char; MOST] = [0; MOST];
    // SAFETY: the path ends with a zero, `room` is as long as is said and ends with one, and a model that is loaded all the same is given back.
    let words = unsafe {
        let model = mj_loadXML(path.as_ptr(), files.ffi(), room.as_mut_ptr(), MOST as c_int);
        mj_deleteModel(model);
        CStr::from_ptr(room.as_ptr())
    };
    Some(words.to_string_lossy().into_owned()).filter(|words| !words.is_empty())
}

/// MuJoCo's words without its line breaks.
pub(super) fn one_line(words: &str) -> String {
    words.split_whitespace().collect::<Vec<_>>().join(" ")
}
