//! Demonstrations: states of an expert, episode by episode, in one `.npz` file.
//!
//! | array | shape | is |
//! |---|---|---|
//! | `observations` | sum (length + 1) x n_obs | raw observations; each episode has one more than steps |
//! | `qpos`, `qvel` | sum (length + 1) x nq, nv | what `Env::set_state` takes |
//! | `lengths` | episodes | policy steps of each |
//! | `dt` | | policy period \[s\] |
//! | `names` | n_obs | what each column of `observations` is |
//! | `actions` | sum length x n_act | optional |

pub mod npz;
mod rows;
mod settings;

pub use rows::{Frame, Frames, MIN_UNIT};
pub use settings::{DemoReward, DemoSettings};

use crate::env::{Env, EnvError};
use crate::mj::Actuator;
use crate::rollout::{RolloutError, Worker, make_env, stream};
use nearl_runtime::Snapshot;
use nearl_runtime::snapshot::write_whole;
use nearl_runtime::task::names::bare;
use npz::{Array, Values};
use std::collections::BTreeMap;
use std::path::Path;

/// Why demonstrations cannot be used.
#[derive(Clone, Debug, thiserror::Error)]
pub enum DemoError {
    /// The system does not give the file.
    #[error("demonstrations '{file}': it cannot be read: {reason}")]
    Unreadable {
        /// Path.
        file: String,
        /// Of the system.
        kind: std::io::ErrorKind,
        /// What the system said.
        reason: String,
    },
    /// The system does not take the file.
    #[error("demonstrations '{file}': it cannot be written: {reason}; give another path with --out")]
    Unwritable {
        /// Path.
        file: String,
        /// What the system said.
        reason: String,
    },
    /// What it holds are no demonstrations, or none for this task.
    #[error("demonstrations '{file}': {reason}")]
    Wrong {
        /// Path.
        file: String,
        /// One sentence naming array, column and episode.
        reason: String,
    },
}

/// One episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    /// Raw observations ((length + 1) x n_obs).
    pub observations: Vec<f64>,
    /// Configurations ((length + 1) x nq).
    pub qpos: Vec<f64>,
    /// Velocities ((length + 1) x nv).
    pub qvel: Vec<f64>,
    /// Actions (length x n_act); empty where the file has none.
    pub actions: Vec<f64>,
    /// Policy steps.
    pub length: usize,
}

/// Every episode of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstrations {
    /// Name of each observation entry (n_obs).
    pub names: Vec<String>,
    /// Policy period \[s\].
    pub dt: f64,
    /// Episodes.
    pub episodes: Vec<Episode>,
}

/// Larger files are refused before they are read [bytes].
const MAX_BYTES: u64 = 4 << 30;
/// Steps that an episode can have: more than a file holds.
const LONGEST: f64 = 1e9;

/// No position, speed, force or observation of a robot is larger, in any unit.
const LARGEST: f64 = 1e9;

impl Demonstrations {
    /// Reads a file whole and checks it.
    ///
    /// # Errors
    /// [`DemoError`] naming array, column and episode; nothing is half read.
    pub fn load(path: &Path) -> Result<Self, DemoError> {
        let file = path.display().to_string();
        let bytes = nearl_runtime::constraints::read_bounded(path, MAX_BYTES, true).map_err(|e| {
            DemoError::Unreadable { file: file.clone(), kind: e.kind(), reason: e.to_string() }
        })?;
        let wrong = |reason| DemoError::Wrong { file: file.clone(), reason };
        let arrays = npz::read(&bytes).map_err(|e| wrong(format!("{e}; write it with numpy.savez")))?;
        Self::of(arrays).map_err(wrong)
    }

    fn of(mut arrays: BTreeMap<String, Array>) -> Result<Self, String> {
        let names = match arrays.remove("names").ok_or("it has no array 'names'")?.values {
            Values::Words(names) => names,
            Values::Numbers(_) | Values::Whole(_) => {
                return Err("array 'names' holds numbers; give the name of each observation".into());
            }
        };
        if let Some((i, name)) = names.iter().enumerate().find(|(i, n)| names[..*i].contains(n)) {
            return Err(format!("column {i} of 'names' is '{name}' a second time"));
        }
        let dt = numbers(&mut arrays, "dt")?.1.first().copied().unwrap_or(f64::NAN);
        if !(dt.is_finite() && dt > 0.0) {
            return Err(format!("'dt' is {dt}; give the policy period in seconds"));
        }
        let lengths = numbers(&mut arrays, "lengths")?.1;
        if let Some((i, l)) =
            lengths.iter().enumerate().find(|(_, l)| !((1.0..=LONGEST).contains(*l) && l.fract() == 0.0))
        {
            return Err(format!(
                "episode {i} has the length {l}; give whole numbers of steps, 1 to {LONGEST:e}"
            ));
        }
        let lengths: Vec<usize> = lengths.into_iter().map(|l| l as usize).collect();
        if lengths.is_empty() {
            return Err("'lengths' is empty; give at least one episode".into());
        }
        let mut episodes: Vec<Episode> =
            lengths.iter().map(|&length| Episode { length, ..Episode::default() }).collect();
        let column = |k: usize| names.get(k).cloned().unwrap_or_else(|| k.to_string());
        let plain = |k: usize| k.to_string();
        type Part = (&'static str, usize, fn(&mut Episode) -> &mut Vec<f64>);
        let parts: [Part; 4] = [
            ("observations", 1, |e| &mut e.observations),
            ("qpos", 1, |e| &mut e.qpos),
            ("qvel", 1, |e| &mut e.qvel),
            ("actions", 0, |e| &mut e.actions),
        ];
        for (name, more, of) in parts {
            if name == "actions" && !arrays.contains_key(name) {
                continue;
            }
            let (shape, values) = numbers(&mut arrays, name)?;
            let rows: usize = lengths.iter().map(|l| l + more).sum();
            let [found, width] = shape[..] else {
                return Err(format!("array '{name}' has {} dimensions, not 2", shape.len()));
            };
            if found != rows {
                return Err(format!("array '{name}' has {found} rows where 'lengths' asks for {rows}"));
            }
            if name == "observations" && width != names.len() {
                return Err(format!("array '{name}' has {width} columns and 'names' {}", names.len()));
            }
            let mut first = 0;
            for (i, e) in episodes.iter_mut().enumerate() {
                let own = &values[first * width..][..(e.length + more) * width];
                first += e.length + more;
                if let Some(at) = own.iter().position(|x| x.is_nan() || x.abs() > LARGEST) {
                    let called = if name == "observations" { column(at % width) } else { plain(at % width) };
                    return Err(format!(
                        "'{name}' is {:e} in episode {i}, row {}, column '{called}', and no robot has numbers beyond {LARGEST:e}; leave the row out",
                        own[at],
                        at / width
                    ));
                }
                of(e).extend_from_slice(own);
            }
        }
        match arrays.keys().next() {
            Some(name) => Err(format!("array '{name}' is none that demonstrations have")),
            None => Ok(Self { names, dt, episodes }),
        }
    }

    /// Writes the file whole.
    ///
    /// # Errors
    /// [`DemoError::Unwritable`] with what the system said.
    pub fn save(&self, path: &Path) -> Result<(), DemoError> {
        let flat = |of: fn(&Episode) -> &Vec<f64>| {
            self.episodes.iter().flat_map(|e| of(e).iter().copied()).collect::<Vec<f64>>()
        };
        let rows: usize = self.episodes.iter().map(|e| e.length + 1).sum();
        let steps = rows - self.episodes.len();
        let table = |rows: usize, values: Vec<f64>| Array {
            shape: vec![rows, values.len() / rows.max(1)],
            values: Values::Numbers(values),
        };
        let lengths: Vec<i64> = self.episodes.iter().map(|e| e.length as i64).collect();
        let mut arrays = vec![
            ("observations", table(rows, flat(|e| &e.observations))),
            ("qpos", table(rows, flat(|e| &e.qpos))),
            ("qvel", table(rows, flat(|e| &e.qvel))),
            ("lengths", Array { shape: vec![lengths.len()], values: Values::Whole(lengths) }),
            ("dt", Array { shape: Vec::new(), values: Values::Numbers(vec![self.dt]) }),
            ("names", Array { shape: vec![self.names.len()], values: Values::Words(self.names.clone()) }),
        ];
        let actions = flat(|e| &e.actions);
        if !actions.is_empty() {
            arrays.push(("actions", table(steps, actions)));
        }
        let unwritable = |reason| DemoError::Unwritable { file: path.display().to_string(), reason };
        let bytes = npz::write(&arrays).map_err(unwritable)?;
        write_whole(path, &bytes).map_err(|e| unwritable(e.to_string()))
    }

    /// The same with the columns of `names`, in that order; whatever else the file has is left out.
    ///
    /// # Errors
    /// One sentence naming a column that is missing.
    pub fn columns(&self, names: &[String]) -> Result<Self, String> {
        let place = |name: &String| {
            let found = self.names.iter().position(|n| bare(n) == bare(name));
            found.ok_or_else(|| format!("it has no column '{name}'; it has {}", self.names.join(" ")))
        };
        let places = names.iter().map(place).collect::<Result<Vec<_>, _>>()?;
        let episodes = self.episodes.iter().map(|e| {
            let rows = e.observations.chunks_exact(self.names.len());
            let observations = rows.flat_map(|row| places.iter().map(|&k| row[k])).collect();
            Episode { observations, ..e.clone() }
        });
        Ok(Self { names: names.to_vec(), dt: self.dt, episodes: episodes.collect() })
    }

    /// Whether the states are those of this environment: period, columns and sizes, and in each episode the first observation, but for what
    /// a reset draws. The environment is left in some state.
    ///
    /// # Errors
    /// One sentence naming what differs, and the episode.
    pub fn check(&self, env: &mut dyn Env, period: f64) -> Result<(), String> {
        if (self.dt - period).abs() > 1e-9 * period {
            return Err(format!("its period is {} s, that of the task {period} s", self.dt));
        }
        let (nq, nv, names) = (env.qpos().len(), env.qvel().len(), env.spec().obs.clone());
        let own = self.columns(&names)?;
        let mut obs = vec![0.0; names.len()];
        for (i, e) in own.episodes.iter().enumerate() {
            let rows = e.length + 1;
            if (e.qpos.len(), e.qvel.len()) != (rows * nq, rows * nv) {
                let (q, v) = (e.qpos.len() / rows, e.qvel.len() / rows);
                return Err(format!(
                    "'qpos' and 'qvel' have {q} and {v} columns where the robot has {nq} and {nv}"
                ));
            }
            let (width, n_act) = (e.actions.len() / e.length.max(1), env.spec().n_act());
            if width != 0 && width != n_act {
                return Err(format!(
                    "'actions' of episode {i} have {width} columns where the robot has {n_act} actuators; record them with the task, or leave them out"
                ));
            }
            if let Some(wrong) = beyond(&e.actions, &env.spec().actuators) {
                return Err(format!("'actions' of episode {i}: {wrong}"));
            }
            let begin = (&e.qpos[..nq], &e.qvel[..nv]);
            let is_drawn = drawn(env, begin).map_err(|error| format!("episode {i}: {error}"))?;
            env.observe(&mut obs);
            // contact forces follow from the step before and are not of the state alone
            let far = |k: &usize| {
                (obs[*k] - e.observations[*k]).abs() > 1e-6 * (1.0 + obs[*k].abs())
                    && !is_drawn[*k]
                    && !names[*k].starts_with("cfrc.")
            };
            if let Some(k) = (0..obs.len()).find(far) {
                return Err(format!(
                    "episode {i} begins with {} = {} where its 'qpos' and 'qvel' give {}",
                    names[k], e.observations[k], obs[k]
                ));
            }
        }
        Ok(())
    }
}

/// How far beyond its actuator's range an action is that nobody meant, as a multiple of the range: what a policy puts out before a clip is less far.
const FAR_BEYOND: f64 = 5.0;

/// Actions (row-major) that are no controls of these actuators: half of a column is outside the range, and its largest far outside.
fn beyond(actions: &[f64], actuators: &[Actuator]) -> Option<String> {
    let n = actuators.len();
    let rows = actions.len() / n.max(1);
    actuators.iter().enumerate().find_map(|(k, actuator)| {
        let (low, high) = (actuator.low, actuator.high);
        let column = || (0..rows).map(move |row| actions[row * n + k]);
        let outside = column().filter(|x| *x < low - 1e-9 || *x > high + 1e-9).count();
        let most = column().fold(0.0, |most: f64, x| if x.abs() > most.abs() { x } else { most });
        let is_far = most.abs() > FAR_BEYOND * low.abs().max(high.abs());
        (rows > 0 && 2 * outside > rows && is_far).then(|| {
            format!(
                "{outside} of {rows} of '{}' are outside its range, {low} to {high}, the furthest {most}; give the actuators' controls in the order of \
                 the robot file, not forces",
                actuator.name
            )
        })
    })
}

/// Episodes of a policy without noise, from ordinary resets, under its limits.
///
/// # Errors
/// [`RolloutError`].
pub fn record(
    snapshot: &Snapshot,
    episodes: usize,
    seed: u64,
) -> Result<(Demonstrations, Vec<f64>), RolloutError> {
    let mut worker = Worker::new(make_env(snapshot)?, snapshot, 1.0, stream(seed, 0))?;
    let task = &snapshot.manifest.task;
    let (mut all, mut returns) = (Vec::new(), Vec::new());
    for _ in 0..episodes {
        let (episode, total) = worker.demonstrate().map_err(RolloutError::from)?;
        all.push(episode);
        returns.push(total);
    }
    let dt = task.time.dt * task.time.policy_every as f64;
    Ok((Demonstrations { names: task.state.observation.clone(), dt, episodes: all }, returns))
}

/// Which entries of the observation of a state, `qpos` and `qvel`, are not of the state alone: commands, goals, noise. They differ from reset to
/// reset.
fn drawn(env: &mut dyn Env, (qpos, qvel): (&[f64], &[f64])) -> Result<Vec<bool>, EnvError> {
    let n = env.spec().obs.len();
    let (mut first, mut obs, mut differs) = (vec![0.0; n], vec![0.0; n], vec![false; n]);
    for k in 0..4 {
        env.reset(&mut stream(0, k))?;
        env.set_state(qpos, qvel)?;
        env.observe(if k == 0 { &mut first } else { &mut obs });
        if k > 0 {
            differs.iter_mut().zip(first.iter().zip(&obs)).for_each(|(d, (a, b))| *d |= a != b);
        }
    }
    Ok(differs)
}

/// Takes an array of numbers: its shape and entries.
fn numbers(arrays: &mut BTreeMap<String, Array>, name: &str) -> Result<(Vec<usize>, Vec<f64>), String> {
    let Array { shape, values } = arrays.remove(name).ok_or(format!("it has no array '{name}'"))?;
    match values {
        Values::Numbers(values) => Ok((shape, values)),
        Values::Whole(values) => Ok((shape, values.into_iter().map(|x| x as f64).collect())),
        Values::Words(_) => Err(format!("array '{name}' holds text; give numbers")),
    }
}
