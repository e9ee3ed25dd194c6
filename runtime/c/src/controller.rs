//! The controller inside a program of one's own.

use super::{REFUSED, guarded, handle, slice, text};
use nearl_runtime::constraints::Status;
use nearl_runtime::snapshot::in_run;
use nearl_runtime::{Controller, Noise, Output, Snapshot, State};
use std::ffi::{c_char, c_int};
use std::path::Path;

/// `nearl_sizes`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sizes {
    nq: usize,
    nv: usize,
    n_obs: usize,
    n_act: usize,
    policy_every: usize,
    dt: f64,
}

/// `nearl_ledger`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Ledger {
    status: i32,
    active: u32,
    iterations: u32,
    raw_violations: u32,
    target_violations: u32,
    reserved: u32,
    moved: f64,
    slack: f64,
    duration_ns: u64,
}

/// `nearl_controller`.
pub struct InProcess {
    controller: Controller,
    sizes: Sizes,
    state: State,
    noise: Noise,
    out: Output,
    /// A finite state was given.
    began: bool,
}

/// Names by number; what is refused has [`REFUSED`].
const NAMES: [&std::ffi::CStr; 7] =
    [c"unchanged", c"clamped", c"solved", c"recovering", c"slowed", c"braked", c"tightening"];

fn number(status: Status) -> c_int {
    match status {
        Status::Unchanged => 0,
        Status::Clamped => 1,
        Status::Solved => 2,
        Status::Recovering => 3,
        Status::Slowed => 4,
        Status::Braked(_) => 5,
        Status::Tightening => 6,
        Status::Refused(_) => REFUSED,
    }
}

impl InProcess {
    fn load(path: &str) -> Result<InProcess, String> {
        let snapshot = Snapshot::load(&in_run(Path::new(path))).map_err(|e| e.to_string())?;
        if let Some(text) = snapshot.manifest.without_policy() {
            return Err(format!("'{path}': {text}"));
        }
        let controller = Controller::new(&snapshot).map_err(|e| e.to_string())?;
        let (state, noise, out) = (controller.state(), controller.noise(), controller.output());
        let sizes = Sizes {
            nq: state.q.len(),
            nv: state.v.len(),
            n_obs: state.obs.len(),
            n_act: controller.n_act(),
            policy_every: controller.policy_every(),
            dt: controller.dt(),
        };
        Ok(InProcess { controller, sizes, state, noise, out, began: false })
    }

    /// Nothing before the first finite state: what is not finite is answered as the last finite one, and there is none.
    fn update(&mut self, q: &[f64], v: &[f64], obs: &[f64], action: &mut [f64]) -> Option<Ledger> {
        self.began = self.began || [q, v, obs].iter().all(|values| values.iter().all(|x| x.is_finite()));
        if !self.began {
            return None;
        }
        self.state.q.copy_from_slice(q);
        self.state.v.copy_from_slice(v);
        self.state.obs.copy_from_slice(obs);
        let status = self.controller.update(&self.state, &self.noise, &mut self.out);
        action.copy_from_slice(&self.out.action);
        let ledger = &self.out.next.ledger;
        Some(Ledger {
            status: number(status),
            active: ledger.active.len() as u32,
            iterations: ledger.iterations,
            raw_violations: ledger.raw_violations.total(),
            target_violations: ledger.target_violations.total(),
            reserved: 0,
            moved: ledger.moved,
            slack: ledger.slack,
            duration_ns: self.out.duration_ns,
        })
    }
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_controller_load(
    snapshot: *const c_char,
    error: *mut c_char,
    error_size: usize,
) -> *mut InProcess {
    let made = guarded(Err("the snapshot broke its validation; export it again".into()), || {
        // SAFETY: by contract.
        InProcess::load(&unsafe { text("snapshot", snapshot) }?)
    });
    // SAFETY: by contract.
    unsafe { handle(made, error, error_size) }
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_controller_sizes(controller: *const InProcess) -> Sizes {
    // SAFETY: by contract.
    unsafe { controller.as_ref() }.map_or(Sizes::default(), |c| c.sizes)
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_controller_update(
    controller: *mut InProcess,
    q: *const f64,
    v: *const f64,
    obs: *const f64,
    action: *mut f64,
    ledger: *mut Ledger,
) -> c_int {
    // SAFETY: by contract.
    let Some(c) = (unsafe { controller.as_mut() }) else { return REFUSED };
    let Sizes { nq, nv, n_obs, n_act, .. } = c.sizes;
    // SAFETY: by contract.
    let given = unsafe { (slice(q, nq), slice(v, nv), slice(obs, n_obs)) };
    let (Some(q), Some(v), Some(obs), false) = (given.0, given.1, given.2, action.is_null()) else {
        return REFUSED;
    };
    // SAFETY: by contract.
    let action = unsafe { std::slice::from_raw_parts_mut(action, n_act) };
    let done = guarded(None, || c.update(q, v, obs, action));
    // SAFETY: by contract.
    if let (Some(done), Some(ledger)) = (done, unsafe { ledger.as_mut() }) {
        *ledger = done;
    }
    done.map_or(REFUSED, |d| d.status)
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_controller_reset(controller: *mut InProcess) {
    // SAFETY: by contract.
    if let Some(c) = unsafe { controller.as_mut() } {
        guarded((), || c.controller.reset());
    }
}

/// See the header.
///
/// # Safety
/// `controller` is null or came from [`nearl_controller_load`] and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_controller_free(controller: *mut InProcess) {
    if !controller.is_null() {
        // SAFETY: by contract.
        guarded((), || drop(unsafe { Box::from_raw(controller) }));
    }
}

/// See the header.
#[unsafe(no_mangle)]
pub extern "C" fn nearl_status_name(status: c_int) -> *const c_char {
    let name = usize::try_from(status).ok().and_then(|i| NAMES.get(i));
    match name {
        Some(name) => name.as_ptr(),
        None if status == REFUSED => c"refused".as_ptr(),
        None => c"unknown".as_ptr(),
    }
}
