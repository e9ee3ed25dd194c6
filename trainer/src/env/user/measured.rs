//! `[noise]` and `[delay]`: what the controller is told of the robot, and when its actions arrive.
//!
//! ```toml
//! [noise]                                  # added to what is measured, one draw an entry and control period
//! q = "0.01 * normal"                      # rad or m, of every joint with one degree of freedom
//! v = "0.5 * uniform"                      # rad/s or m/s
//! base_v = "0.1 * uniform"                 # m/s, of the free base in its axes
//! base_w = "0.2 * uniform"                 # rad/s
//! tilt = "0.02 * normal"                   # rad, about every axis of the base
//! bias = { q = "0.02 * uniform" }          # the same, drawn once an episode
//!
//! [delay]                                  # control periods, drawn once an episode
//! action = 2
//! observation = "1 + uniform"              # rounded
//! ```

use std::collections::VecDeque;

use rand_chacha::ChaCha8Rng;

use super::commands::{drawn, is_a_number, is_ever};
use super::expression::Expression;
use super::quantity::{Names, Quantity, base};
use super::settings::{Mistake, Text, mistake};
use crate::mj::{Joint, Sim};

/// Longest delay \[control periods\].
const LONGEST: f64 = 100.0;

const KINDS: [&str; 5] = ["q", "v", "base_v", "base_w", "tilt"];

/// Noise of each of [`KINDS`].
type Noises = [Option<Expression<Quantity>>; 5];

/// A state with its observation.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Reading {
    /// MuJoCo's convention.
    pub(super) q: Vec<f64>,
    pub(super) v: Vec<f64>,
    pub(super) obs: Vec<f64>,
}

/// What lies between the robot and its controller.
#[derive(Clone)]
pub(super) struct Measured {
    noise: Noises,
    bias: Noises,
    delays: [Option<Expression<Quantity>>; 2],
    /// Entries of `qpos` and `qvel` of the joints with one degree of freedom.
    joints: Vec<(usize, usize)>,
    base: Option<(usize, usize)>,
    /// Bias of each entry of a reading in this episode: of `q`, `v`, then of tilt, velocity and angular velocity of the base.
    q_bias: Vec<f64>,
    v_bias: Vec<f64>,
    base_bias: [[f64; 3]; 3],
    /// Delay of actions and of readings in this episode \[control periods\].
    delay: [usize; 2],
    actions: VecDeque<Vec<f64>>,
    readings: VecDeque<Reading>,
}

impl Measured {
    /// Reads the sections; none where the task has neither.
    pub(super) fn read(
        noise: &toml::Table,
        delay: &toml::Table,
        joints: &[Joint],
        start: &Names,
    ) -> Result<Option<Measured>, Mistake> {
        if noise.is_empty() && delay.is_empty() {
            return Ok(None);
        }
        let mut plain = noise.clone();
        let bias = match plain.remove("bias") {
            None => toml::Table::new(),
            Some(toml::Value::Table(bias)) => bias,
            Some(_) => {
                return Err(mistake(
                    "noise.bias",
                    "it is a table of what 'noise' may hold, drawn once an episode",
                ));
            }
        };
        let free = base(joints).map(|joint| (joint.idx_q, joint.idx_v));
        let read = |section: &str, table: &toml::Table| noises(section, table, free.is_some(), start);
        let mut delays = [None, None];
        for (name, value) in delay {
            let key = format!("delay.{name}");
            let place = match name.as_str() {
                "action" => 0,
                "observation" => 1,
                _ => return Err(mistake(key, "there are 'action' and 'observation'")),
            };
            let of = Text::read(&key, value, start)?;
            if !is_a_number(&of) {
                return Err(mistake(key, "what is drawn is not a number every time"));
            }
            if !is_ever(&of, &(-0.5..=LONGEST + 0.5)) {
                return Err(mistake(
                    key,
                    format!("no delay that is drawn has 0 to {LONGEST} control periods"),
                ));
            }
            delays[place] = Some(of);
        }
        let single = joints.iter().filter(|joint| joint.nv == 1);
        let joints: Vec<_> = single.map(|joint| (joint.idx_q, joint.idx_v)).collect();
        Ok(Some(Measured {
            noise: read("noise", &plain)?,
            bias: read("noise.bias", &bias)?,
            delays,
            q_bias: vec![0.0; joints.len()],
            v_bias: vec![0.0; joints.len()],
            joints,
            base: free,
            base_bias: [[0.0; 3]; 3],
            delay: [0; 2],
            actions: VecDeque::new(),
            readings: VecDeque::new(),
        }))
    }

    /// Draws what holds for an episode.
    pub(super) fn begin(&mut self, rng: &mut ChaCha8Rng, level: f64) {
        let [q, v, base_v, base_w, tilt] = &self.bias;
        let of = |draw: &Option<_>, rng: &mut ChaCha8Rng| {
            draw.as_ref().map_or(0.0, |draw| drawn(draw, rng, level))
        };
        self.q_bias.iter_mut().for_each(|x| *x = of(q, rng));
        self.v_bias.iter_mut().for_each(|x| *x = of(v, rng));
        for (bias, draw) in self.base_bias.iter_mut().zip([tilt, base_v, base_w]) {
            bias.iter_mut().for_each(|x| *x = of(draw, rng));
        }
        for (delay, draw) in self.delay.iter_mut().zip(&self.delays) {
            let periods = of(draw, rng).round();
            *delay = if periods.is_finite() { periods.clamp(0.0, LONGEST) as usize } else { 0 };
        }
        self.actions.clear();
        self.readings.clear();
    }

    /// Delay of actions and of readings in this episode \[control periods\].
    pub(super) fn delay(&self) -> [usize; 2] {
        self.delay
    }

    /// The action that arrives in the period in which `asked` is asked for. Until the first has arrived it is there from the start.
    pub(super) fn arriving<'a>(&'a self, asked: &'a [f64]) -> &'a [f64] {
        let late = self.delay[0];
        match (late, self.actions.front()) {
            (0, _) | (_, None) => asked,
            (late, Some(first)) => self.actions.iter().rev().nth(late - 1).unwrap_or(first),
        }
    }

    /// An action was asked for.
    pub(super) fn ask(&mut self, action: &[f64]) {
        if self.delay[0] == 0 {
            return;
        }
        let mut place = match self.actions.len() >= self.delay[0] {
            true => self.actions.pop_front().unwrap_or_default(),
            false => Vec::new(),
        };
        place.clear();
        place.extend_from_slice(action);
        self.actions.push_back(place);
    }

    /// What is known of the robot now; before the first reading nothing is.
    pub(super) fn reading(&self) -> Option<&Reading> {
        self.readings.front()
    }

    /// Measures the present state; `observe` makes the observation of a measured configuration and velocity.
    pub(super) fn measure(
        &mut self,
        sim: &Sim,
        rng: &mut ChaCha8Rng,
        level: f64,
        observe: impl FnOnce(&[f64], &[f64], &mut Vec<f64>),
    ) {
        let mut reading = match self.readings.len() > self.delay[1] {
            true => self.readings.pop_front().unwrap_or_default(),
            false => Reading::default(),
        };
        reading.q.clear();
        reading.q.extend_from_slice(sim.qpos());
        reading.v.clear();
        reading.v.extend_from_slice(sim.qvel());
        self.disturb(&mut reading, rng, level);
        observe(&reading.q, &reading.v, &mut reading.obs);
        self.readings.push_back(reading);
    }

    fn disturb(&self, to: &mut Reading, rng: &mut ChaCha8Rng, level: f64) {
        let [q, v, base_v, base_w, tilt] = &self.noise;
        let mut of = |draw: &Option<_>| draw.as_ref().map_or(0.0, |draw| drawn(draw, rng, level));
        for (&(i, _), bias) in self.joints.iter().zip(&self.q_bias) {
            to.q[i] += bias + of(q);
        }
        for (&(_, i), bias) in self.joints.iter().zip(&self.v_bias) {
            to.v[i] += bias + of(v);
        }
        let Some((iq, iv)) = self.base else { return };
        let [turned, moved, spun] = self.base_bias;
        let turned = turned.map(|bias| bias + of(tilt));
        let moved = moved.map(|bias| bias + of(base_v));
        let spun = spun.map(|bias| bias + of(base_w));
        let quaternion: [f64; 4] = [0, 1, 2, 3].map(|k| to.q[iq + 3 + k]);
        // Velocities of the base are disturbed in its axes; MuJoCo's linear one is in the world's.
        let moved = rotated(quaternion, moved);
        for k in 0..3 {
            to.v[iv + k] += moved[k];
            to.v[iv + 3 + k] += spun[k];
        }
        if turned != [0.0; 3] {
            let new = times(quaternion, of_rotation(turned));
            to.q[iq + 3..iq + 7].copy_from_slice(&new);
        }
    }
}

fn noises(section: &str, table: &toml::Table, floats: bool, start: &Names) -> Result<Noises, Mistake> {
    let mut noises: Noises = Default::default();
    for (name, value) in table {
        let key = format!("{section}.{name}");
        let Some(at) = KINDS.iter().position(|known| known == name) else {
            return Err(mistake(
                key,
                format!("nothing of that name is measured; there are {}", KINDS.join(", ")),
            ));
        };
        if at > 1 && !floats {
            return Err(mistake(key, "the robot's base is fixed; there are 'q' and 'v'"));
        }
        noises[at] = Some(Text::read(&key, value, start)?);
    }
    Ok(noises)
}

/// Unit quaternion `w x y z` of a rotation vector \[rad\].
fn of_rotation(r: [f64; 3]) -> [f64; 4] {
    let angle = r.iter().map(|x| x * x).sum::<f64>().sqrt();
    let by = if angle > 1e-12 { (0.5 * angle).sin() / angle } else { 0.5 };
    [(0.5 * angle).cos(), by * r[0], by * r[1], by * r[2]]
}

/// The product of two quaternions `w x y z`.
fn times(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// `R v` for the rotation of a unit quaternion `w x y z`.
fn rotated(q: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    let [_, x, y, z] = times(times(q, [0.0, v[0], v[1], v[2]]), [q[0], -q[1], -q[2], -q[3]]);
    [x, y, z]
}
