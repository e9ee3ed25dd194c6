//! How far a plant leaves its limits, measured on the simulator's own state and not on anyone's promise.

/// Limits of a robot. Infinity is no limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Limits {
    /// Smallest configuration (nq) \[rad or m\].
    pub lower_position: Vec<f64>,
    /// Largest configuration (nq) \[rad or m\].
    pub upper_position: Vec<f64>,
    /// Largest speed of each degree of freedom (nv) \[rad/s or m/s\].
    pub velocity: Vec<f64>,
    /// Largest acceleration of each degree of freedom (nv), as the difference of velocities a tick apart \[rad/s² or m/s²\].
    pub acceleration: Vec<f64>,
    /// Largest force or torque on each degree of freedom (nv) \[N·m or N\].
    pub effort: Vec<f64>,
}

/// Why limits make no sense.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LimitError {
    /// Vectors that do not go together.
    #[error(
        "the limits have {lower} lower and {upper} upper positions, {velocity} velocities, {acceleration} accelerations and {effort} efforts: \
             positions must be equal in number, and all others too"
    )]
    Lengths {
        /// Lower positions given.
        lower: usize,
        /// Upper positions given.
        upper: usize,
        /// Velocities given.
        velocity: usize,
        /// Accelerations given.
        acceleration: usize,
        /// Efforts given.
        effort: usize,
    },
    /// A range that holds nothing.
    #[error("{what}[{index}]: no value lies between {lower} and {upper}")]
    Empty {
        /// Which limit.
        what: &'static str,
        /// Which entry.
        index: usize,
        /// Lower end.
        lower: f64,
        /// Upper end.
        upper: f64,
    },
}

/// How far one state is outside its limits; 0 inside.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Excess {
    /// Largest excess of a position \[rad or m\].
    pub position: f64,
    /// Largest excess of a speed \[rad/s or m/s\].
    pub velocity: f64,
    /// Largest excess of an acceleration \[rad/s² or m/s²\].
    pub acceleration: f64,
    /// Largest excess of a force \[N·m or N\].
    pub effort: f64,
}

/// The record of one kind of limit.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Worst {
    /// States in which some entry was outside by more than the tolerance.
    pub states: u64,
    /// Largest excess seen \[the limit's unit\]; infinite after a state that was not finite.
    pub excess: f64,
    /// Entry of `q` (positions) or `v` (speeds, forces) where it was.
    pub index: usize,
    /// State, counted from 0, in which it was.
    pub at: u64,
}

/// Compares every state of a plant with its limits.
#[derive(Debug, Clone, PartialEq)]
pub struct Meter {
    limits: Limits,
    tolerance: f64,
    dt: f64,
    /// Velocity (nv) of the state before.
    before: Vec<f64>,
    states: u64,
    position: Worst,
    velocity: Worst,
    acceleration: Worst,
    effort: Option<Worst>,
}

impl Meter {
    /// A meter that counts a state as outside when some entry exceeds its limit by more than `tolerance` (in the limit's
    /// unit; 0 is exact, 1e-9 forgives rounding). An acceleration is the difference of two velocities `dt` \[s\] apart, and may exceed its
    /// limit by what that makes of the tolerance.
    ///
    /// # Errors
    /// [`LimitError`] for lengths that do not go together and ranges that are empty or NaN.
    pub fn new(limits: Limits, tolerance: f64, dt: f64) -> Result<Meter, LimitError> {
        let (lower, upper) = (limits.lower_position.len(), limits.upper_position.len());
        let (velocity, effort) = (limits.velocity.len(), limits.effort.len());
        let acceleration = limits.acceleration.len();
        if lower != upper || velocity != effort || velocity != acceleration {
            return Err(LimitError::Lengths { lower, upper, velocity, acceleration, effort });
        }
        let positions = limits.lower_position.iter().zip(&limits.upper_position).map(|(l, u)| (*l, *u));
        nonempty("position", positions)?;
        nonempty("velocity", limits.velocity.iter().map(|v| (-v, *v)))?;
        nonempty("acceleration", limits.acceleration.iter().map(|a| (-a, *a)))?;
        nonempty("effort", limits.effort.iter().map(|e| (-e, *e)))?;
        let [position, velocity, acceleration] = [Worst::default(); 3];
        let before = vec![0.0; limits.velocity.len()];
        Ok(Meter { limits, tolerance, dt, before, states: 0, position, velocity, acceleration, effort: None })
    }

    /// Takes `v` (nv) as the velocity from which the next state's acceleration counts: an episode begins.
    ///
    /// # Panics
    /// When it has another length than the limits.
    pub fn begin(&mut self, v: &[f64]) {
        self.before.copy_from_slice(v);
    }

    /// Measures one state: `q` (nq), `v` (nv) and, where it is known, the force that acted on each degree of freedom (nv).
    ///
    /// # Panics
    /// When a slice has another length than its limits.
    pub fn observe(&mut self, q: &[f64], v: &[f64], force: Option<&[f64]>) -> Excess {
        let Limits { lower_position, upper_position, velocity, acceleration, effort } = &self.limits;
        assert!(q.len() == lower_position.len() && v.len() == velocity.len());
        let (at, tolerance) = (self.states, self.tolerance);
        self.states += 1;
        // The last term makes an infinite entry NaN where there is no limit either.
        let outside = |i: usize| (lower_position[i] - q[i]).max(q[i] - upper_position[i]) + 0.0 * q[i];
        let position = self.position.note(at, tolerance, (0..q.len()).map(outside));
        let too_fast = v.iter().zip(velocity).map(|(v, limit)| v.abs() - limit);
        let velocity = self.velocity.note(at, tolerance, too_fast);
        let change = v.iter().zip(&self.before).map(|(new, old)| ((new - old) / self.dt).abs());
        let too_sudden = change.zip(acceleration).map(|(a, limit)| a - limit);
        let acceleration = self.acceleration.note(at, 2.0 * tolerance / self.dt, too_sudden);
        self.before.copy_from_slice(v);
        let effort = force.map_or(0.0, |force| {
            assert_eq!(force.len(), effort.len(), "one force for each degree of freedom");
            let too_strong = force.iter().zip(effort).map(|(f, limit)| f.abs() - limit);
            self.effort.get_or_insert_default().note(at, tolerance, too_strong)
        });
        Excess { position, velocity, acceleration, effort }
    }

    /// What is compared with.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// States measured.
    pub fn states(&self) -> u64 {
        self.states
    }

    /// Record of the position limits.
    pub fn position(&self) -> Worst {
        self.position
    }

    /// Record of the velocity limits.
    pub fn velocity(&self) -> Worst {
        self.velocity
    }

    /// Record of the acceleration limits.
    pub fn acceleration(&self) -> Worst {
        self.acceleration
    }

    /// Record of the effort limits; `None` where no force was ever given.
    pub fn effort(&self) -> Option<Worst> {
        self.effort
    }

    /// All records in the order of [`METERS`](nearl_runtime::link::METERS); `None` for what was not measured.
    pub fn records(&self) -> [Option<Worst>; 4] {
        [Some(self.position), Some(self.velocity), Some(self.acceleration), self.effort]
    }
}

impl Worst {
    /// Takes the excess of every entry (negative inside, NaN for a value that is not a number).
    fn note(&mut self, at: u64, tolerance: f64, excesses: impl Iterator<Item = f64>) -> f64 {
        let mut largest = 0.0;
        for (index, excess) in excesses.enumerate() {
            let excess = if excess.is_nan() { f64::INFINITY } else { excess };
            if excess > largest {
                largest = excess;
                if excess > self.excess {
                    *self = Worst { states: self.states, excess, index, at };
                }
            }
        }
        self.states += u64::from(largest > tolerance);
        largest
    }
}

fn nonempty(what: &'static str, ranges: impl Iterator<Item = (f64, f64)>) -> Result<(), LimitError> {
    for (index, (lower, upper)) in ranges.enumerate() {
        if lower.is_nan() || upper.is_nan() || lower > upper {
            return Err(LimitError::Empty { what, index, lower, upper });
        }
    }
    Ok(())
}
