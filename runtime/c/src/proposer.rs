//! A process that proposes in place of a policy.

use super::{REFUSED, guarded, handle, slice, text, waiting};
use nearl_runtime::link::{ProposerLink, RobotName};
use std::ffi::{CString, c_char, c_int};

/// `nearl_proposer`.
pub struct Proposer {
    link: ProposerLink,
    entries: Vec<CString>,
    is_action: bool,
}

/// Numbers of a configuration, a velocity and an observation at most.
const MOST: [usize; 3] =
    [nearl_runtime::link::MAX_JOINTS, nearl_runtime::link::MAX_JOINTS, nearl_runtime::link::MAX_OBS];

/// # Safety
/// `name` is null or ends with a zero.
unsafe fn open(name: *const c_char, patience: f64) -> Result<Proposer, String> {
    // SAFETY: by contract.
    let name = unsafe { text("name", name)? };
    let name = RobotName::new(&name).map_err(|e| e.to_string())?;
    let patience = waiting(patience).ok_or("patience is no number; give the seconds to wait")?;
    let link = ProposerLink::open(&name, patience).map_err(|e| e.to_string())?;
    let asked = link.asked();
    let entries = asked.entries.into_iter().map(CString::new).collect::<Result<_, _>>();
    Ok(Proposer {
        link,
        entries: entries.map_err(|_| "a name of an entry holds a zero")?,
        is_action: asked.is_action,
    })
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_open(
    name: *const c_char,
    patience: f64,
    error: *mut c_char,
    error_size: usize,
) -> *mut Proposer {
    // SAFETY: by contract.
    let made = guarded(Err("the link broke; report it".into()), || unsafe { open(name, patience) });
    // SAFETY: by contract.
    unsafe { handle(made, error, error_size) }
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_entries(proposer: *const Proposer) -> usize {
    // SAFETY: by contract.
    unsafe { proposer.as_ref() }.map_or(0, |p| p.entries.len())
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_entry(proposer: *const Proposer, k: usize) -> *const c_char {
    // SAFETY: by contract.
    let entry = unsafe { proposer.as_ref() }.and_then(|p| p.entries.get(k));
    entry.map_or(std::ptr::null(), |name| name.as_ptr())
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_is_action(proposer: *const Proposer) -> c_int {
    // SAFETY: by contract.
    unsafe { proposer.as_ref() }.map_or(REFUSED, |p| c_int::from(p.is_action))
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_state(
    proposer: *mut Proposer,
    patience: f64,
    q: *mut f64,
    nq: usize,
    v: *mut f64,
    nv: usize,
    obs: *mut f64,
    n_obs: usize,
) -> c_int {
    // SAFETY: by contract.
    let Some(proposer) = (unsafe { proposer.as_mut() }) else { return REFUSED };
    let places = [(q, nq), (v, nv), (obs, n_obs)];
    if places.iter().zip(MOST).any(|((to, n), most)| *n > most || (*n > 0 && to.is_null())) {
        return REFUSED;
    }
    let Some(patience) = waiting(patience) else { return REFUSED };
    guarded(REFUSED, || {
        let Some(state) = proposer.link.wait_for_state(patience) else { return 0 };
        let found = [state.q(), state.v(), state.obs()];
        if places.iter().zip(found).any(|((_, n), from)| *n != 0 && *n != from.len()) {
            return REFUSED;
        }
        for ((to, n), from) in places.into_iter().zip(found) {
            // SAFETY: by contract there is room for `n` numbers, and there are as many.
            unsafe { std::ptr::copy_nonoverlapping(from.as_ptr(), to, n) };
        }
        1
    })
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_propose(
    proposer: *mut Proposer,
    values: *const f64,
    n: usize,
) -> c_int {
    // SAFETY: by contract.
    let (Some(proposer), Some(values)) = (unsafe { proposer.as_mut() }, unsafe { slice(values, n) }) else {
        return REFUSED;
    };
    guarded(REFUSED, || if proposer.link.propose(values) { 0 } else { REFUSED })
}

/// See the header.
///
/// # Safety
/// `proposer` is null or came from [`nearl_proposer_open`] and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_proposer_close(proposer: *mut Proposer) {
    if !proposer.is_null() {
        // SAFETY: by contract.
        guarded((), || drop(unsafe { Box::from_raw(proposer) }));
    }
}
