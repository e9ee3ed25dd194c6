//! The tests of loop, links and log, as one program. `clock.rs` beside it is a program of its own: it gives every thread of its process
//! another wall clock.

#![allow(unreachable_pub)] // modules of a test program

#[path = "../arm/mod.rs"]
mod arm;
#[path = "../attack/mod.rs"]
mod attack;
#[path = "../faults/mod.rs"]
mod faults;
#[path = "../toy/mod.rs"]
mod toy;

mod allocation;
mod crash;
mod cycle;
mod limits;
mod link;
mod log;
mod panda;
mod replay;
mod verify;
