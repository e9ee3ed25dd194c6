//! One attack: a closed loop in which the robot goes exactly where each target says.

use super::attacker::Attacker;
use super::meter::{Gauge, Passage, ROUNDING};
use super::scene::Scene;
use nearl_constraints::*;

/// Ticks of an episode; then the robot stands at the start again.
const EPISODE: usize = 2500;

/// What a run came to.
#[derive(Debug, Default, Clone, Copy)]
pub struct Seen {
    pub ticks: usize,
    /// Steps measured beyond a limit.
    pub over: usize,
    /// Largest excess measured: share of the limit or, of positions, rad or m.
    pub worst: f64,
    /// Targets that are not the nearest allowed state, because no brake from that was found.
    pub slowed: usize,
    /// Ticks of the stored brake with a proposal that holds numbers.
    pub braked: usize,
    /// The measured state is outside, says the projector.
    pub recovering: usize,
    /// Targets that break a limit of a state within all of them, says the projector.
    pub alarms: usize,
    /// Of slowed and braked ticks: how much further from the proposal than the answer without a brake, in largest velocity changes of a
    /// period; the sum and the largest.
    pub further: (f64, f64),
}

/// Attacks the scene for `ticks` ticks.
pub fn attack(model: &Model, scene: &Scene, settings: &Settings, ticks: usize, seed: u64) -> Seen {
    let all: Vec<usize> = (0..model.nv()).collect();
    let mut projector = Projector::new(model, &scene.limits, &all, settings.clone()).unwrap();
    let unbraked = Settings { braking: Braking::Certified, ..settings.clone() };
    let mut without = Projector::new(model, &scene.limits, &all, unbraked).unwrap();
    let mut gauge = Gauge::new(model, Period::new(settings.dt, settings.sub_steps));
    let unit = super::scene::ACCELERATION * settings.dt * (2.0 * model.nv() as f64).sqrt();
    let (mut raw, mut target) = (Proposal::new(model), Target::new(model));
    let (mut best, mut seen) = (Target::new(model), Seen { worst: f64::NEG_INFINITY, ..Seen::default() });
    let (mut q, mut v) = (scene.start.clone(), vec![0.0; model.nv()]);
    let mut attacker = Attacker::new(seed, model.nv());
    for tick in 0..ticks {
        if tick % EPISODE == 0 {
            q.copy_from_slice(&scene.start);
            v.fill(0.0);
            gauge.begin();
            projector.forget();
            without.forget();
        }
        let numbers = attacker.propose(&mut gauge, &scene.meters, (&q, &v), &mut raw);
        let status = projector.project(&q, &v, &raw, &mut target);
        let passage = Passage { q: &q, v: &v, q_next: &target.q, v_next: &target.v };
        let excess = gauge.worst(&scene.meters, passage);
        gauge.take(passage);
        if projector.needs_previous() {
            projector.remember(&target);
        }
        seen.ticks += 1;
        if excess > ROUNDING || excess.is_nan() {
            if seen.over == 0 && std::env::var_os("SHOW").is_some() {
                println!("tick {tick}: {excess:e} {status:?} {:?}", target.ledger);
            }
            seen.over += 1;
        }
        seen.worst = seen.worst.max(excess);
        seen.recovering += usize::from(status == Status::Recovering);
        seen.alarms += usize::from(target.ledger.target_breaks());
        let held = match status {
            Status::Slowed => Some(&mut seen.slowed),
            Status::Braked(_) if numbers => Some(&mut seen.braked),
            _ => None,
        };
        if let Some(held) = held {
            *held += 1;
            if without.project(&q, &v, &raw, &mut best).is_ok() {
                let more = (target.ledger.moved - best.ledger.moved) / unit;
                seen.further = (seen.further.0 + more, seen.further.1.max(more));
            }
        }
        if without.needs_previous() {
            without.remember(&target);
        }
        (q, v) = (target.q.clone(), target.v.clone());
    }
    seen
}
