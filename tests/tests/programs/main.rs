//! Tests that start the programs themselves, as a program of their own: loops keep their period only while nothing beside them takes the
//! processor for long, as the tests of `suite` do.

mod common;

mod bad_input;
mod bombs;
mod doubts;
mod examples;
mod online;
mod printed;
mod processes;
mod recording;
mod serve;
mod serve_attack;
mod serve_clients;
mod serve_stress;
mod serve_training;
mod sweep;
