//! Confirms from a flight log alone what a NEARL loop promised: in every tick every hard limit held for the target, the target was the
//! nearest allowed state where the tick says so, and a way to stop existed.
//!
//! Nothing here is shared with the projector: no code, no library of rigid bodies, no solver. The robot is the numbers in the log's snapshot,
//! its equations of motion are written anew, limits are looked at for what they mean, and that an answer is optimal is shown from the
//! multipliers that the log carries. What is not known here is refused by name, and a tick that cannot be confirmed is counted so.

mod before;
mod claims;
mod collision;
mod cut;
mod drives;
mod facts;
mod jerk;
mod limit_check;
mod limits;
mod log;
mod motion;
mod moved;
mod optimum;
mod period;
mod promise;
mod proposed;
mod report;
mod robot;
mod rows;
mod session;
mod space;
mod steps;
mod stop;
mod tick;

pub(crate) use period::Period;

pub use log::{VerifyError, verify};
pub use report::{Report, Violation};
pub use tick::ROOM;
