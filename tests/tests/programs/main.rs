//! Tests that start the programs themselves, as one program: beside them runs nothing that takes the processor for long.

#[path = "../common/mod.rs"]
mod common;

mod bad_input;
mod bombs;
mod doubts;
mod examples;
mod online;
mod printed;
mod processes;
mod serve;
mod serve_attack;
mod serve_clients;
mod serve_training;
mod sweep;
