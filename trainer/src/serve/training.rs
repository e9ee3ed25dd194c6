//! A client that learns: its environments go on from one of its requests to the next.

use super::pool::{Order, Start, Task};
use crate::rollout::Worker;
use nearl_rollout_protocol::{Constraints, Request, Training};
use nearl_runtime::Snapshot;
use std::sync::Arc;

/// The environments of one client.
pub(super) struct Session {
    places: Vec<Place>,
    /// The networks they act by.
    snapshot: Arc<Snapshot>,
    n_steps: usize,
    /// The longest segment so far: room for it is kept.
    most: usize,
    /// What the environments that have none yet begin with.
    start: Start,
}

/// What trainings keep of the server's memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Load {
    /// Environments.
    pub(super) n_envs: u64,
    /// Policy steps of all of them.
    pub(super) steps: u64,
}

impl std::iter::Sum for Load {
    fn sum<I: Iterator<Item = Load>>(loads: I) -> Load {
        loads.fold(Load::default(), |a, b| Load {
            n_envs: a.n_envs.saturating_add(b.n_envs),
            steps: a.steps.saturating_add(b.steps),
        })
    }
}

/// One environment with its share of the request under way.
struct Place {
    stage: Stage,
    worker: Option<Box<Worker>>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// So many steps are left.
    Left(usize),
    /// A portion is being simulated, and so many steps are left after it.
    AtWork(usize),
    /// All steps were simulated.
    Collected,
    /// And handed out.
    Carried,
}

impl Session {
    /// Environments that begin with `request`.
    pub(super) fn begin(request: &Request, training: &Training, snapshot: Arc<Snapshot>) -> Session {
        let n_steps = usize::try_from(request.n_steps).unwrap_or(usize::MAX);
        let places = (0..training.n_envs).map(|_| Place { stage: Stage::Left(n_steps), worker: None });
        let Training { stream, gamma, moved_penalty, .. } = *training;
        let projection = request.constraints != Constraints::Off;
        let start = Start { seed: request.seed, stream, projection, gamma, moved_penalty };
        Session { places: places.collect(), snapshot, n_steps, most: n_steps, start }
    }

    /// Goes on with `request`.
    pub(super) fn go_on(&mut self, request: &Request, snapshot: Arc<Snapshot>) {
        self.snapshot = snapshot;
        self.n_steps = usize::try_from(request.n_steps).unwrap_or(usize::MAX);
        self.most = self.most.max(self.n_steps);
        self.places.iter_mut().for_each(|place| place.stage = Stage::Left(self.n_steps));
    }

    /// Environments.
    pub(super) fn n_envs(&self) -> usize {
        self.places.len()
    }

    /// The networks it acts by.
    pub(super) fn snapshot(&self) -> &Snapshot {
        &self.snapshot
    }

    /// Environments, and steps that there is room for.
    pub(super) fn load(&self) -> Load {
        let n_envs = self.n_envs() as u64;
        Load { n_envs, steps: n_envs.saturating_mul(self.most as u64) }
    }

    /// True while an environment waits for its next portion.
    pub(super) fn wants(&self) -> bool {
        self.places.iter().any(|p| matches!(p.stage, Stage::Left(_)))
    }

    /// The next portion, of the first environment that waits for one: the first are done, and sent, while the last are simulated.
    pub(super) fn task(&mut self, slot: u64, rows: usize) -> Option<Task> {
        let i = self.places.iter().position(|p| matches!(p.stage, Stage::Left(_)))?;
        let place = &mut self.places[i];
        let Stage::Left(left) = place.stage else { return None };
        let rows = rows.min(left);
        place.stage = Stage::AtWork(left - rows);
        let begins = left == self.n_steps;
        let order = Order::Segment {
            snapshot: Arc::clone(&self.snapshot),
            begins: begins.then_some(self.n_steps),
            start: Start { stream: self.start.stream.wrapping_add(i as u64), ..self.start },
        };
        Some(Task { slot, place: Some(i), worker: place.worker.take(), rows, order })
    }

    /// Takes the worker back after its portion.
    pub(super) fn take_back(&mut self, place: usize, worker: Box<Worker>) {
        let place = &mut self.places[place];
        place.worker = Some(worker);
        place.stage = match place.stage {
            Stage::AtWork(0) => Stage::Collected,
            Stage::AtWork(left) => Stage::Left(left),
            other => other,
        };
    }

    /// What the next environment that is done collected: its number, how many numbers follow, and these.
    pub(super) fn carry(&mut self) -> Option<Vec<f64>> {
        let i = self.places.iter().position(|p| p.stage == Stage::Collected)?;
        let place = &mut self.places[i];
        place.stage = Stage::Carried;
        let mut numbers = vec![i as f64, 0.0];
        place.worker.as_ref()?.rows.collected.carry(&mut numbers);
        numbers[1] = (numbers.len() - 2) as f64;
        Some(numbers)
    }

    /// True once everything was handed out.
    pub(super) fn is_over(&self) -> bool {
        self.places.iter().all(|p| p.stage == Stage::Carried)
    }
}
