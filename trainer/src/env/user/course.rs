//! What happens in an episode beside the physics: commands, pushes, and what is followed from step to step.
//!
//! An episode draws one number, its seed, and everything else comes out of that: seed, start and actions make an episode repeatable.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::commands::Commands;
use super::contacts::Contacts;
use super::curriculum::Curriculum;
use super::pushes::Pushes;
use super::random::Random;
use crate::mj::{MjError, Sim};

/// The present episode.
#[derive(Clone)]
pub(super) struct Course {
    pub(super) commands: Commands,
    pub(super) pushes: Option<Pushes>,
    pub(super) contacts: Contacts,
    pub(super) random: Option<Random>,
    pub(super) curriculum: Option<Curriculum>,
    /// The curriculum rises and falls.
    climbs: bool,
    pub(super) forces: Forces,
    /// More is drawn in each episode than what stands here: noise and delays.
    pub(super) draws_more: bool,
    /// Degrees of freedom with an actuator, each once.
    pub(super) driven: Vec<usize>,
    /// First entries of the free base in `qpos` and `qvel`; never read where the base is fixed.
    pub(super) base: (usize, usize),
    /// Unit vector of gravity in the world.
    pub(super) down: [f64; 3],
    /// How far the curriculum has come, 0 to 1.
    pub(super) level: f64,
    /// Squared change of the action in this control period.
    pub(super) action_change: f64,
    last_action: Vec<f64>,
    /// Control periods since the episode began.
    ticks: u64,
    seed: u64,
    rng: ChaCha8Rng,
    dt: f64,
}

impl Course {
    /// `drives`: the degree of freedom of each actuator; one that two actuators drive is one.
    pub(super) fn new(dt: f64, drives: Vec<usize>, base: Option<(usize, usize)>, down: [f64; 3]) -> Course {
        let (n_act, mut driven) = (drives.len(), drives);
        driven.sort_unstable();
        driven.dedup();
        Course {
            commands: Commands::default(),
            pushes: None,
            contacts: Contacts::default(),
            random: None,
            curriculum: None,
            climbs: false,
            forces: Forces { before: vec![f64::NAN; driven.len()], ..Forces::default() },
            draws_more: false,
            last_action: vec![0.0; n_act],
            driven,
            base: base.unwrap_or_default(),
            down,
            level: 1.0,
            action_change: 0.0,
            ticks: 0,
            seed: 0,
            rng: ChaCha8Rng::seed_from_u64(0),
            dt,
        }
    }

    /// Whether an episode draws anything beside its start.
    fn draws(&self) -> bool {
        let draws = !self.commands.is_empty() || self.pushes.is_some() || self.random.is_some();
        draws || self.draws_more || self.curriculum.is_some()
    }

    /// Puts the curriculum at its start.
    pub(super) fn start_curriculum(&mut self) {
        if let Some(curriculum) = &self.curriculum {
            (self.level, self.climbs) = (curriculum.start, true);
        }
    }

    /// An episode ended in which the terms of the reward summed to `sums`.
    pub(super) fn end(&mut self, sums: &[f64], longest: usize) {
        if let Some(curriculum) = self.curriculum.as_ref().filter(|_| self.climbs) {
            self.level = curriculum.after(self.level, sums, self.ticks, longest);
        }
    }

    /// Draws a new episode.
    pub(super) fn draw(&mut self, rng: &mut ChaCha8Rng) {
        if self.draws() {
            self.seed = rng.next_u64();
        }
    }

    /// Gives `sim` the robot of the episode that was drawn, again or for the first time.
    pub(super) fn prepare(&mut self, sim: &mut Sim) -> Result<(), MjError> {
        self.rng = ChaCha8Rng::seed_from_u64(self.seed);
        let Some(random) = &mut self.random else { return Ok(()) };
        random.draw(&mut self.rng, self.level);
        sim.change(&random.physique)
    }

    /// Begins the episode.
    pub(super) fn begin(&mut self) {
        self.forces.before.fill(f64::NAN);
        (self.forces.largest, self.forces.fastest) = (0.0, 0.0);
        (self.ticks, self.action_change) = (0, 0.0);
        self.contacts.clear();
        self.commands.draw(&mut self.rng, self.level);
        if let Some(pushes) = &mut self.pushes {
            pushes.begin(&mut self.rng);
        }
    }

    /// Follows a control period that ended in `sim`'s state.
    pub(super) fn follow(&mut self, sim: &Sim, action: &[f64]) {
        self.contacts.follow(sim, self.dt);
        self.forces.follow(sim, &self.driven);
        let change = |(a, b): (&f64, &f64)| (a - b) * (a - b);
        let is_first = self.ticks == 0;
        let changed: f64 = self.last_action.iter().zip(action).map(change).sum();
        self.action_change = if is_first { 0.0 } else { changed };
        self.last_action.copy_from_slice(action);
    }

    /// What happens between this control period and the next.
    pub(super) fn advance(&mut self, sim: &mut Sim) {
        self.ticks += 1;
        if self.commands.are_due(self.ticks) {
            self.commands.draw(&mut self.rng, self.level);
        }
        if let Some(pushes) = &mut self.pushes {
            pushes.advance(&mut self.rng, sim, self.ticks, self.level);
        }
    }

    /// Random numbers of what is drawn in the episode.
    pub(super) fn rng(&mut self) -> &mut ChaCha8Rng {
        &mut self.rng
    }

    /// A random stream of the episode's own beside the others.
    pub(super) fn noise(&self) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(1);
        rng
    }

    /// Control periods since the episode began.
    pub(super) fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Numbers from which [`Course::begin`] makes the same episode.
    pub(super) fn circumstances(&self) -> Vec<f64> {
        match self.draws() {
            true => vec![f64::from((self.seed >> 32) as u32), f64::from(self.seed as u32), self.level],
            false => Vec::new(),
        }
    }

    pub(super) fn set_circumstances(&mut self, circumstances: &[f64]) {
        if let [high, low, level] = circumstances {
            self.seed = (*high as u64) << 32 | *low as u64;
            self.level = *level;
        }
    }

    /// `R' v` for the rotation `R` (base to world) in the configuration `q`, MuJoCo's convention.
    pub(super) fn to_base(&self, q: &[f64], v: [f64; 3]) -> [f64; 3] {
        let [w, x, y, z] = [3, 4, 5, 6].map(|i| -q[self.base.0 + i]);
        let u = [x, y, z];
        let w = -w;
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let uv = cross(u, v);
        let uuv = cross(u, uv);
        let length = w * w + x * x + y * y + z * z;
        [0, 1, 2].map(|i| v[i] + 2.0 * (w * uv[i] + uuv[i]) / length)
    }
}

/// Forces of the actuators, from control period to control period.
#[derive(Clone, Default)]
pub(super) struct Forces {
    /// Those of the period before; NaN at the start of an episode.
    before: Vec<f64>,
    /// Largest magnitude \[N·m or N\].
    pub(super) largest: f64,
    /// Largest magnitude of a change since the control period before \[N·m or N\].
    pub(super) fastest: f64,
}

impl Forces {
    fn follow(&mut self, sim: &Sim, driven: &[usize]) {
        (self.largest, self.fastest) = (0.0, 0.0);
        for (&dof, before) in driven.iter().zip(&mut self.before) {
            let force = sim.applied_force_of(dof);
            self.largest = self.largest.max(force.abs());
            self.fastest = self.fastest.max((force - *before).abs()); // not by NaN
            *before = force;
        }
    }
}
