//! Another process proposes in place of the policy: whatever it proposes, the robot stays within its limits; when it falls silent, the robot brakes.

use std::time::Duration;

use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use nearl_runtime::{PolicyKind, Snapshot};

use super::ROUNDING;
use super::flight::{Flight, plan, settings};
use super::stage::*;
use super::system::{signal, until};
use crate::arm::*;
use crate::toy;

const AGE: u64 = 30_000_000;
const HOLD: u64 = 20_000_000;

fn asked() -> ProposerSettings {
    ProposerSettings { age_limit: AGE, hold: HOLD }
}

/// The body of the process: states far beyond every limit, a few hundred times a second.
pub fn propose(name: &RobotName) {
    let mut link = ProposerLink::open(name, Duration::from_secs(30)).unwrap();
    let n = link.asked().entries.len();
    for seed in 1.. {
        if link.wait_for_state(Duration::from_millis(100)).is_some() {
            let values: Vec<f64> = weights(seed, n).iter().map(|w| 20.0 * f64::from(*w)).collect();
            assert!(link.propose(&values));
        }
        pause(3);
    }
}

fn flight() -> Flight {
    let core = CoreSettings { proposer: Some(asked()), ramp: 0, ..settings() };
    Flight::new(&snapshot(1, |_| {}), core, plan(&[]))
}

/// A proposal as the process would send it, from the newest state.
fn proposal(flight: &Flight, seq: u64, values: &[f64]) -> ProposalMessage {
    let question = flight.core.controller.controller.question().unwrap();
    let state = flight.core.record.state.header;
    let mut message = ProposalMessage::zeroed();
    message.header = Header { schema: 0, epoch: 9, seq, stamp: state.stamp };
    (message.state_epoch, message.state_seq, message.state_stamp) = (state.epoch, state.seq, state.stamp);
    (message.kind, message.names) = (question.kind, hash_names(&question.names));
    message.n = values.len() as u32;
    message.values_mut().copy_from_slice(values);
    message
}

/// The pose the arm starts in, moved by `by` [rad], at rest.
fn pose(by: f64) -> Vec<f64> {
    let panda = Panda::new();
    panda.q.iter().map(|q| q + by).chain(panda.v).collect()
}

#[test]
fn a_proposal_is_followed_held_and_missed_by_its_age() {
    let mut flight = flight();
    flight.fly(5);
    assert_eq!(flight.at(5), (Mode::Hold, Reason::SilentProposer), "nothing was proposed yet");
    for seq in 1..=500 {
        let by = 0.1 * (seq as f64 / 400.0).min(1.0);
        flight.proposal = Some(proposal(&flight, seq, &pose(by)));
        flight.fly(1);
    }
    assert_eq!(flight.at(505), (Mode::Active, Reason::None));
    let reached = flight.panda.q.iter().zip(&pose(0.1)).map(|(q, goal)| (q - goal).abs()).fold(0.0, f64::max);
    assert!(reached < 1e-3, "it goes where it is told: {reached} rad away");
    // The state it answers was one period old when it came; 30 ms later it is held, 20 ms after that it counts no more.
    flight.fly(28);
    assert_eq!(flight.at(533), (Mode::Active, Reason::None));
    flight.fly(20);
    assert_eq!(flight.at(534), (Mode::Degraded, Reason::SilentProposer));
    assert_eq!(flight.at(553), (Mode::Degraded, Reason::SilentProposer));
    flight.fly(1);
    assert_eq!(flight.at(554), (Mode::Braking, Reason::SilentProposer));
    for seq in 501..=511 {
        flight.proposal = Some(proposal(&flight, seq, &pose(0.1)));
        flight.fly(1);
    }
    assert_eq!((flight.at(563).0, flight.at(564).0), (Mode::Braking, Mode::Active), "10 good ticks");
    let counters = flight.counters();
    assert_eq!((counters.proposals, counters.held_proposals, counters.silent_proposer), (511, 20, 6));
    flight.assert_within_limits(ROUNDING);
}

#[test]
fn what_is_held_comes_to_rest_where_it_was_sent() {
    let mut flight = flight();
    flight.fly(2);
    let mut goal = pose(0.05);
    goal[N..].fill(0.5);
    flight.proposal = Some(ProposalMessage { state_stamp: u64::MAX, ..proposal(&flight, 1, &goal) });
    flight.fly(25);
    let fastest = flight.panda.v.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    let away = flight.panda.q.iter().zip(&goal).map(|(q, goal)| (q - goal).abs()).fold(0.0, f64::max);
    assert_eq!(flight.at(27).0, Mode::Active, "a time stamp that has not come yet is as old as its arrival");
    flight.fly(4 + 20);
    assert_eq!(flight.at(51).0, Mode::Degraded, "and no younger");
    assert!(fastest < 0.6 && away < 0.06, "{fastest} rad/s, {away} rad");
    flight.fly(100);
    assert!(flight.panda.v.iter().all(|v| v.abs() < 1e-2), "{:?}", flight.panda.v);
}

#[test]
fn what_is_no_answer_is_refused_and_counted() {
    let mut flight = flight();
    flight.fly(3);
    let good = proposal(&flight, 1, &pose(0.1));
    let mut spoilt = vec![
        ProposalMessage { names: 7, ..good },
        ProposalMessage { kind: PROPOSES_ACTIONS, ..good },
        ProposalMessage { n: u32::MAX, ..good },
        ProposalMessage { n: 3, ..good },
        ProposalMessage { state_epoch: 2, ..good },
        ProposalMessage { state_seq: 1_000, ..good },
        ProposalMessage { state_seq: 0, ..good },
    ];
    let mut odd = good;
    odd.values[3] = f64::NAN;
    spoilt.push(odd);
    let n = spoilt.len() as u64;
    for (k, message) in spoilt.into_iter().enumerate() {
        flight.proposal =
            Some(ProposalMessage { header: Header { seq: 1 + k as u64, ..message.header }, ..message });
        flight.fly(1);
    }
    let counters = flight.counters();
    assert_eq!((counters.refused_proposals, counters.proposals, counters.overtaken_proposals), (n, 0, 0));
    assert_eq!(flight.at(11), (Mode::Hold, Reason::SilentProposer));
    flight.proposal = Some(proposal(&flight, n + 5, &pose(0.1)));
    flight.fly(2);
    assert_eq!((flight.at(13).0, flight.counters().overtaken_proposals), (Mode::Active, 4));
}

#[test]
fn actions_without_a_guard_are_not_asked_for() {
    let direct = |guard| {
        let mut snapshot: Snapshot = snapshot(1, |m| {
            m.policy = PolicyKind::Direct;
            m.task.constraints.guard = guard;
        });
        let layers = &mut snapshot.networks.policy.layers;
        layers[1].n_out = N;
        let n_in = layers[1].n_in;
        layers[1].weight.truncate(N * n_in);
        layers[1].bias.truncate(N);
        snapshot.networks.policy_log_std = vec![0.0; N];
        let name = RobotName::new("asked").unwrap();
        let robot = describe(&snapshot.manifest, true).unwrap().message(&name).unwrap();
        Pilot::new(&snapshot, &robot).unwrap().question()
    };
    assert_eq!(direct(nearl_constraints::Guard::Off), None);
    let question = direct(nearl_constraints::Guard::Model).unwrap();
    assert_eq!((question.kind, question.names), (PROPOSES_ACTIONS, (0..N).map(joint).collect()));
}

#[test]
fn fault_49_a_proposer_killed_or_stopped_is_held_then_braked_and_its_successor_taken_up() {
    let stage = Stage::new("proposer");
    let plant = start_with(&stage.name, &stage.first, FaultPlan::default(), Duration::from_micros(500));
    let stop = Stop::new();
    let log = stage.log();
    let run = RunSettings { proposer: Some(asked()), log: Some(log.clone()), ..toy::settings() };
    let running = execute_with(&stage.name, &stage.file(), &stop, run);
    let mut viewer = stage.viewer();
    let mut is = |mode: Mode| {
        let found = || viewer.health().is_some_and(|h| h.mode == mode.code());
        until(mode.name(), found);
    };
    is(Mode::Hold);
    let first = stage.start("proposer");
    is(Mode::Active);
    pause(100);
    let second = ProposerLink::open(&stage.name.0, Duration::ZERO).err();
    assert_eq!(second, Some(LinkError::Taken { name: stage.name.0.clone(), role: "proposer" }));
    signal(&first, libc::SIGSTOP);
    is(Mode::Braking);
    signal(&first, libc::SIGCONT);
    is(Mode::Active);
    kill(first);
    is(Mode::Braking);
    let next = stage.start("proposer");
    is(Mode::Active);
    pause(100);
    kill(next);
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (arm, _) = plant.end();
    let c = &report.counters;
    assert!(c.proposals > 20 && c.held_proposals > 0 && c.silent_proposer > 0, "{report}");
    assert!(c.raw_violations > 20, "it must ask for too much: {report}");
    assert_eq!((c.target_violations, report.modes["fault"]), (0, 0), "{report}");
    assert!(arm.worst.iter().all(|e| *e <= ROUNDING), "{:?}", arm.worst);
    assert!(report.proposer.as_ref().unwrap().answer.p50 > 0, "{report}");
    let replayed = nearl_runtime::log::replay(&log).unwrap();
    assert_eq!((replayed.difference, replayed.complete), (None, true));
}
