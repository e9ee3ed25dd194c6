//! A robot's driver as the plant of a loop.

use super::{REFUSED, guarded, handle, slice, text, waiting};
use nearl_runtime::link::{Exchange, Robot, RobotName, STATE_RESET, Turn};
use std::ffi::{c_char, c_int};

/// `nearl_robot`.
#[repr(C)]
#[derive(Debug)]
pub struct RobotIn {
    joints: *const *const c_char,
    n_joints: usize,
    observation: *const *const c_char,
    n_obs: usize,
    nq: usize,
    nv: usize,
    nu: usize,
    dt: f64,
    watchdog: f64,
    lockstep: c_int,
}

/// `nearl_state`.
#[repr(C)]
#[derive(Debug)]
pub struct StateIn {
    time: f64,
    q: *const f64,
    v: *const f64,
    obs: *const f64,
    episode: u64,
    begins: c_int,
    braked: c_int,
}

/// `nearl_plant`.
pub struct Plant {
    exchange: Exchange,
    nq: usize,
    nv: usize,
    nu: usize,
    n_obs: usize,
}

/// # Safety
/// The pointers of `robot` are null or point to as many strings as it says.
unsafe fn open(name: *const c_char, robot: *const RobotIn) -> Result<Plant, String> {
    // SAFETY: by contract.
    let (name, robot) = unsafe { (text("name", name)?, robot.as_ref().ok_or("robot is NULL")?) };
    let names = |what: &str, start, n| {
        // SAFETY: by contract.
        let list: &[*const c_char] = unsafe { slice(start, n) }.ok_or_else(|| format!("{what} is NULL"))?;
        // SAFETY: by contract.
        list.iter().map(|&one| unsafe { text(what, one) }).collect::<Result<Vec<_>, _>>()
    };
    for (what, value) in [("dt", robot.dt), ("watchdog", robot.watchdog)] {
        if !(value.is_finite() && value > 0.0) {
            return Err(format!("{what} is {value} s; give a positive number of seconds"));
        }
    }
    let described = Robot {
        joints: names("joints", robot.joints, robot.n_joints)?,
        observation: names("observation", robot.observation, robot.n_obs)?,
        limits: 0,
        stated: None,
        nq: robot.nq,
        nv: robot.nv,
        nu: robot.nu,
        dt: robot.dt,
        lockstep: robot.lockstep != 0,
    };
    let name = RobotName::new(&name).map_err(|e| e.to_string())?;
    let exchange = Exchange::open(&name, &described, robot.watchdog).map_err(|e| e.to_string())?;
    Ok(Plant { exchange, nq: robot.nq, nv: robot.nv, nu: robot.nu, n_obs: robot.n_obs })
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_plant_open(
    name: *const c_char,
    robot: *const RobotIn,
    error: *mut c_char,
    error_size: usize,
) -> *mut Plant {
    // SAFETY: by contract.
    let made = guarded(Err("the link broke; report it".into()), || unsafe { open(name, robot) });
    // SAFETY: by contract.
    unsafe { handle(made, error, error_size) }
}

impl Plant {
    /// # Safety
    /// The pointers of `state` are null or point to as many numbers as the robot has.
    unsafe fn exchange(&mut self, state: &StateIn, patience: f64, action: &mut [f64]) -> Option<c_int> {
        let patience = waiting(patience)?.as_secs_f64();
        // SAFETY: by contract.
        let (q, v, obs) =
            unsafe { (slice(state.q, self.nq)?, slice(state.v, self.nv)?, slice(state.obs, self.n_obs)?) };
        let message = self.exchange.state();
        (message.time, message.episode) = (state.time, state.episode);
        message.bits = if state.begins != 0 { STATE_RESET } else { 0 };
        if state.braked != 0 {
            self.exchange.braked();
        }
        let (turn, given) = match self.exchange.exchange(q, v, obs, patience) {
            Turn::Act(given) => (0, given),
            Turn::Hold(given) => (1, given),
            Turn::Brake => return Some(2), // also where the loop is of another robot; it will say so
        };
        action.copy_from_slice(given);
        Some(turn)
    }
}

/// See the header.
///
/// # Safety
/// As the header says.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_plant_exchange(
    plant: *mut Plant,
    state: *const StateIn,
    patience: f64,
    action: *mut f64,
) -> c_int {
    // SAFETY: by contract.
    let (Some(plant), Some(state)) = (unsafe { plant.as_mut() }, unsafe { state.as_ref() }) else {
        return REFUSED;
    };
    if action.is_null() && plant.nu > 0 {
        return REFUSED;
    }
    let n = plant.nu;
    // SAFETY: by contract; an empty slice needs no memory.
    let action = if n == 0 { &mut [][..] } else { unsafe { std::slice::from_raw_parts_mut(action, n) } };
    // SAFETY: by contract.
    guarded(REFUSED, || unsafe { plant.exchange(state, patience, action) }.unwrap_or(REFUSED))
}

/// See the header.
///
/// # Safety
/// `plant` is null or came from [`nearl_plant_open`] and is not used again.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nearl_plant_close(plant: *mut Plant) {
    if !plant.is_null() {
        // SAFETY: by contract.
        guarded((), || drop(unsafe { Box::from_raw(plant) }));
    }
}
