//! A robot of a simulation's own whose masses, frictions and drives change from episode to episode.

use mujoco_rs::mujoco_c::{mjModel, mjtByte, mjtSameFrame};
use mujoco_rs::wrappers::mj_model::MjModel;

use super::{MjError, Model, Sim, guard, pairs};

/// What a frame coincides with.
const NONE: mjtByte = mjtSameFrame::mjSAMEFRAME_NONE as mjtByte;
const INERTIA: mjtByte = mjtSameFrame::mjSAMEFRAME_INERTIA as mjtByte;
const INERTIA_ROTATION: mjtByte = mjtSameFrame::mjSAMEFRAME_INERTIAROT as mjtByte;

/// Those numbers of a compiled robot that a task may change, in MuJoCo's order.
#[derive(Debug, Clone, PartialEq)]
pub struct Physique {
    /// Mass of each body \[kg\], the world included.
    pub mass: Vec<f64>,
    /// Principal moments of inertia of each body \[kg m²\].
    pub inertia: Vec<[f64; 3]>,
    /// Centre of mass of each body in its frame \[m\].
    pub centre: Vec<[f64; 3]>,
    /// Sliding, torsional and rolling friction of each solid.
    pub friction: Vec<[f64; 3]>,
    /// Rotor inertia of each degree of freedom \[kg m² or kg\].
    pub armature: Vec<f64>,
    /// Gain of each actuator.
    pub gain: Vec<f64>,
    /// Constant, position and velocity coefficient of each actuator's force.
    pub bias: Vec<[f64; 3]>,
    /// Smallest and largest force of each actuator \[N·m or N\].
    pub force_range: Vec<[f64; 2]>,
    /// Height of each field of bumps \[m\].
    pub bumps: Vec<f64>,
}

impl Model {
    /// A copy that shares nothing and takes no short cut where a centre of mass is a frame's origin: only such a robot may be changed.
    pub fn copied(&self) -> Model {
        let copy: MjModel = (*self.0).clone();
        let m: *mut mjModel = std::ptr::from_ref(copy.ffi()).cast_mut();
        // SAFETY: the arrays are this copy's own and have these lengths.
        unsafe {
            for body in 0..(*m).nbody as usize {
                *(*m).body_sameframe.add(body) = NONE;
            }
            for (list, n) in [((*m).geom_sameframe, (*m).ngeom), ((*m).site_sameframe, (*m).nsite)] {
                for i in 0..n as usize {
                    if *list.add(i) == INERTIA || *list.add(i) == INERTIA_ROTATION {
                        *list.add(i) = NONE;
                    }
                }
            }
        }
        Model(copy.into())
    }

    /// Whether MuJoCo counts on a body's centre of mass being where it is.
    pub fn is_simple(&self, body: usize) -> bool {
        self.0.body_simple()[body] != 0
    }

    /// Names of the bodies, the world included.
    pub fn body_names(&self) -> Vec<String> {
        (0..self.n_bodies()).map(|body| self.body_name(body)).collect()
    }

    /// What may be changed, as it is now.
    pub fn physique(&self) -> Physique {
        let m = &self.0;
        let first_three = |list: &[f64]| [list[0], list[1], list[2]];
        Physique {
            mass: m.body_mass().to_vec(),
            inertia: m.body_inertia().to_vec(),
            centre: m.body_ipos().to_vec(),
            friction: m.geom_friction().to_vec(),
            armature: m.dof_armature().to_vec(),
            gain: m.actuator_gainprm().iter().map(|gain| gain[0]).collect(),
            bias: m.actuator_biasprm().iter().map(|bias| first_three(bias)).collect(),
            force_range: m.actuator_forcerange().to_vec(),
            bumps: m.hfield_size().iter().map(|size| size[2]).collect(),
        }
    }
}

impl Sim {
    /// A simulation of a robot of its own, which [`Sim::change`] may change.
    ///
    /// # Errors
    /// As [`Sim::new`].
    pub fn apart(model: &Model) -> Result<Sim, MjError> {
        Sim::new(&model.copied())
    }

    /// Gives the robot these numbers and evaluates what MuJoCo derives from them; the state is to be set afterwards. Only for a simulation
    /// [`Sim::apart`] and those made for its own robot, on one thread.
    ///
    /// # Errors
    /// [`MjError::Engine`].
    ///
    /// # Panics
    /// When the numbers are of another robot.
    pub fn change(&mut self, to: &Physique) -> Result<(), MjError> {
        let now = self.model().physique();
        let lengths =
            |p: &Physique| [p.mass.len(), p.friction.len(), p.armature.len(), p.gain.len(), p.bumps.len()];
        assert!(lengths(&now) == lengths(to), "the numbers of another robot");
        let of_pairs = pairs::frictions(&self.model().0, &to.friction);
        self.call_with_model(|m, d| {
            // SAFETY: the arrays have the lengths compared above, and nothing else reads this robot meanwhile.
            unsafe {
                write(m, to);
                for (i, friction) in of_pairs.iter().enumerate() {
                    (0..5).for_each(|k| *(*m).pair_friction.add(5 * i + k) = friction[k]);
                }
                guard::mj_setConst(m, d);
            }
        })
    }
}

/// # Safety
/// `to` has the lengths of the robot's arrays.
unsafe fn write(m: *mut mjModel, to: &Physique) {
    // SAFETY: the caller's promise.
    unsafe {
        for (i, mass) in to.mass.iter().enumerate() {
            *(*m).body_mass.add(i) = *mass;
            for k in 0..3 {
                *(*m).body_inertia.add(3 * i + k) = to.inertia[i][k];
                *(*m).body_ipos.add(3 * i + k) = to.centre[i][k];
            }
        }
        for (i, friction) in to.friction.iter().enumerate() {
            (0..3).for_each(|k| *(*m).geom_friction.add(3 * i + k) = friction[k]);
        }
        for (i, armature) in to.armature.iter().enumerate() {
            *(*m).dof_armature.add(i) = *armature;
        }
        for (i, gain) in to.gain.iter().enumerate() {
            *(*m).actuator_gainprm.add(i * mujoco_rs::mujoco_c::mjNGAIN as usize) = *gain;
            let bias = (*m).actuator_biasprm.add(i * mujoco_rs::mujoco_c::mjNBIAS as usize);
            (0..3).for_each(|k| *bias.add(k) = to.bias[i][k]);
            (0..2).for_each(|k| *(*m).actuator_forcerange.add(2 * i + k) = to.force_range[i][k]);
        }
        for (i, height) in to.bumps.iter().enumerate() {
            *(*m).hfield_size.add(4 * i + 2) = *height;
        }
    }
}
