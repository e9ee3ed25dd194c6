//! The loop without threads and links: the Panda of the other tests, a fault plan, and a scripted clock.

use nearl_runtime::Snapshot;
use nearl_runtime::link::*;
use nearl_runtime::rt::*;

use crate::arm::*;
use crate::toy::DT;

const PERIOD: u64 = 1_000_000;

pub struct Flight {
    pub core: Core<Pilot>,
    pub records: Vec<Record>,
    pub panda: Panda,
    pub sequence: Sequence,
    /// What another process proposes in the next period.
    pub proposal: Option<ProposalMessage>,
    /// Control periods that pass in the plant's own loop for each that it announced.
    pub stretch: u32,
    /// What the driver makes of the velocities that it tells, as a share of them.
    pub told: f64,
    /// The plant's clock [s].
    pub clock: f64,
    plan: FaultPlan,
    brake: Brake,
    robot: RobotMessage,
    last: StateMessage,
    /// Held back by a reordering.
    later: Option<StateMessage>,
    action: ActionMessage,
    now: u64,
    tick: u64,
}

pub fn settings() -> CoreSettings {
    CoreSettings {
        period: PERIOD,
        sync: Sync::Plant,
        age_limit: 20 * PERIOD,
        real_time: true,
        stop_speed: 1e-2,
        jump: RunSettings::default().jump,
        ramp: 50,
        modes: ModeLimits::default(),
        explore: None,
        proposer: None,
    }
}

pub fn plan(faults: &[(u64, u64, FaultKind)]) -> FaultPlan {
    let fault = |&(tick, count, kind): &(u64, u64, FaultKind)| Fault { tick, count, kind };
    FaultPlan { seed: 7, faults: faults.iter().map(fault).collect() }
}

impl Flight {
    pub fn new(snapshot: &Snapshot, settings: CoreSettings, plan: FaultPlan) -> Flight {
        let robot = describe(&snapshot.manifest, false).unwrap();
        let robot = robot.message(&RobotName::new("flight").unwrap()).unwrap();
        let controller = Pilot::new(snapshot, &robot).unwrap();
        let first = Box::new(Loaded { id: 0, controller });
        Flight {
            core: Core::new(settings, first, 0, plan.clone()),
            records: Vec::new(),
            panda: Panda::new(),
            sequence: Sequence::default(),
            proposal: None,
            stretch: 1,
            told: 1.0,
            clock: DT,
            brake: Brake::new(&snapshot.manifest).unwrap().unwrap(),
            plan,
            robot,
            last: StateMessage::zeroed(),
            later: None,
            action: ActionMessage::zeroed(),
            now: PERIOD,
            tick: 0,
        }
    }

    /// The random policy of the other tests under `faults`, for `ticks` of the plant.
    pub fn of(faults: &[(u64, u64, FaultKind)], ticks: u64) -> Flight {
        let mut flight = Flight::new(&stochastic(1), settings(), plan(faults));
        flight.fly(ticks);
        flight
    }

    pub fn fly(&mut self, ticks: u64) {
        for _ in 0..ticks {
            self.period();
        }
    }

    pub fn swap(&mut self, snapshot: &Snapshot) {
        let controller = Pilot::new(snapshot, &self.robot).unwrap();
        *self.core.controller = Loaded { id: self.core.controller.id + 1, controller };
        self.period_with(true);
    }

    fn period(&mut self) {
        self.period_with(false);
    }

    /// One period of the plant: measure, transmit, compute, apply.
    fn period_with(&mut self, swapped: bool) {
        self.tick += 1;
        let mut state = StateMessage::zeroed();
        self.panda.observe(&mut state);
        state.v.iter_mut().for_each(|v| *v *= self.told);
        (state.tick, state.time) = (self.tick, self.clock);
        self.plan.spoil(self.tick, &mut state, &self.last);
        self.last = state;
        state.header = Header { schema: 0, epoch: 1, seq: self.tick, stamp: self.now };
        let kinds: Vec<FaultKind> = self.plan.at(self.tick).map(|(_, kind)| kind).collect();
        let mut arrived = self.later.take().into_iter().collect::<Vec<_>>();
        for kind in &kinds {
            if let FaultKind::Late { age } = kind {
                state.header.stamp -= (age * 1e9) as u64;
            }
        }
        if kinds.contains(&FaultKind::Reorder) {
            self.later = Some(state);
        } else if !kinds.contains(&FaultKind::Drop) {
            arrived.insert(0, state);
        }
        if kinds.contains(&FaultKind::Duplicate) {
            arrived.push(state);
        }
        let mut fresh = None;
        for state in arrived {
            if self.sequence.accept(&state.header) {
                fresh = Some(state);
            }
        }
        // Without a state the loop waits, and the plant holds the last action.
        if let Some(state) = fresh {
            self.compute(&state, swapped);
        }
        self.apply();
        self.now += PERIOD;
        self.clock += f64::from(self.stretch) * DT;
    }

    fn compute(&mut self, state: &StateMessage, swapped: bool) {
        let begin = self.now + 10_000;
        self.core.swap(swapped);
        let proposal = self.proposal.take();
        let (fresh, proposal) = (Some(state), proposal.as_ref());
        self.core.update(&Inputs { due: 0, begin, stop: false, fresh, proposal });
        let spent = (self.core.rehearsed_periods() * PERIOD as f64) as u64;
        self.core.close(begin + spent.max(5_000));
        let record = self.core.record;
        (self.action.nu, self.action.action) = (record.output.nu, record.output.action);
        self.records.push(record);
    }

    /// The action, or the drive's own brake where there is none.
    fn apply(&mut self) {
        let mut action = self.action;
        if action.nu == 0 {
            let (_, torque) = self.brake.update(&self.panda.q, &self.panda.v);
            action.nu = torque.len() as u32;
            action.action[..torque.len()].copy_from_slice(torque);
        }
        assert!(action.action().iter().all(|a| a.is_finite()), "an action that is not finite");
        (0..self.stretch).for_each(|_| self.panda.apply(&action));
    }

    /// Mode and reason of a tick of the loop, from 1.
    pub fn at(&self, tick: usize) -> (Mode, Reason) {
        (self.records[tick - 1].mode, self.records[tick - 1].reason)
    }

    pub fn counters(&self) -> Counters {
        self.core.record.counters
    }

    pub fn first(&self, mode: Mode) -> Option<(u64, Reason)> {
        self.records.iter().find(|r| r.mode == mode).map(|r| (r.tick, r.reason))
    }

    /// Position, velocity and torque of the arm itself never left the robot file's limits, and it did move.
    pub fn assert_within_limits(&self, slack: f64) {
        let worst = self.panda.worst;
        assert!(worst.iter().all(|excess| *excess <= slack), "position, velocity, torque: {worst:?}");
        let fastest = self.panda.speeds.iter().copied().fold(0.0, f64::max);
        assert!(fastest > 0.1, "the arm must move for this to mean anything: {fastest} rad/s");
    }
}
