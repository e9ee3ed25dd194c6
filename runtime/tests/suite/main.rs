//! The tests of loop, links and log that need no process of their own, as one program.

#[path = "../arm/mod.rs"]
mod arm;
#[path = "../attack/mod.rs"]
mod attack;
#[path = "../toy/mod.rs"]
mod toy;

mod crash;
mod cycle;
mod limits;
mod link;
mod log;
mod panda;
mod replay;
mod verify;
