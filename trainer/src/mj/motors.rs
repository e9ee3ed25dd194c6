//! MuJoCo's actuators as motors.

use nearl_runtime::constraints::description::{Command, JointDescription, Motor, RobotDescription};

use mujoco_rs::mujoco_c::mjtDisableBit;
use mujoco_rs::wrappers::mj_model::{MjtBias, MjtDyn, MjtEq, MjtGain, MjtObjBase, MjtTrn, MjtWrap};

use super::Model;

/// Adds the motors of joints with one dof, with their rotors and dampers; what else drives the robot is noted.
pub(super) fn add(model: &Model, robot: &mut RobotDescription) {
    for id in 0..model.n_actuators() {
        let name = model.actuator_name(id);
        match model.driven_joint(id) {
            Some(joint) if model.0.actuator_ctrlnum()[id] == 1 => {
                let motor = model.motor(id, name, &joint);
                load(model, id, motor.gear, robot, &joint);
                robot.motors.push(motor);
            }
            _ => robot.notes.push(format!(
                "actuator '{name}' does not drive a joint with one dof and is not modelled: nothing commands it, and a simulation holds it at control 0"
            )),
        }
    }
    for joint in (0..model.0.jnt_type().len()).filter(|id| model.is_tied(*id)).map(|id| model.joint_name(id))
    {
        robot
            .bodies
            .iter_mut()
            .flat_map(|body| &mut body.joints)
            .filter(|j| j.name == joint)
            .for_each(|j| j.held = true);
    }
}

/// A motor's rotor and dampers act on the joint by the square of the gear.
fn load(model: &Model, id: usize, gear: f64, robot: &mut RobotDescription, joint: &str) {
    let joints = robot.bodies.iter_mut().flat_map(|body| &mut body.joints);
    let Some(joint): Option<&mut JointDescription> = joints.into_iter().find(|j| j.name == joint) else {
        return;
    };
    joint.armature += gear * gear * model.0.actuator_armature()[id];
    joint.damping += gear * gear * model.0.actuator_damping()[id];
    joint.drive_damping += gear * gear * model.implicit_damping(id).unwrap_or(0.0);
}

impl Model {
    pub(super) fn n_actuators(&self) -> usize {
        self.0.actuator_trntype().len()
    }

    pub(super) fn actuator_name(&self, id: usize) -> String {
        self.name(MjtObjBase::mjOBJ_ACTUATOR, id).unwrap_or_else(|| match self.driven_joint(id) {
            Some(joint) => joint,
            None => format!("number {id}"),
        })
    }

    /// Name of the joint with one dof that an actuator drives.
    pub(super) fn driven_joint(&self, id: usize) -> Option<String> {
        let kind = self.0.actuator_trntype()[id];
        let on_joint = matches!(kind, MjtTrn::mjTRN_JOINT | MjtTrn::mjTRN_JOINTINPARENT);
        let joint = usize::try_from(self.0.actuator_trnid()[id][0]).ok().filter(|_| on_joint)?;
        Some(self.joint(joint)).filter(|j| j.nv == 1).map(|j| j.name)
    }

    /// What the law of an actuator damps and `implicitfast` takes implicitly [N·m·s/rad or N·s/m], before its gear; `None` where that changes with
    /// the state, is below 0 or acts on more than one dof.
    pub(super) fn implicit_damping(&self, id: usize) -> Option<f64> {
        let m = &self.0;
        if m.opt().integrator != mujoco_rs::mujoco_c::mjtIntegrator::mjINT_IMPLICITFAST as i32 {
            return Some(0.0);
        }
        let damping = match m.actuator_biastype()[id] {
            MjtBias::mjBIAS_NONE => 0.0,
            MjtBias::mjBIAS_AFFINE => 0.0 - m.actuator_biasprm()[id][2],
            _ => return None,
        };
        let on_one = || self.driven_joint(id).is_some() && m.actuator_ctrlnum()[id] == 1;
        let is_one = damping == 0.0 || (damping > 0.0 && on_one());
        (is_one && m.actuator_gaintype()[id] == MjtGain::mjGAIN_FIXED).then_some(damping)
    }

    /// The tendon that an actuator pulls.
    pub(super) fn tendon_of(&self, id: usize) -> Option<usize> {
        let is_tendon = self.0.actuator_trntype()[id] == MjtTrn::mjTRN_TENDON;
        usize::try_from(self.0.actuator_trnid()[id][0]).ok().filter(|_| is_tendon)
    }

    /// Whether a joint with one dof is tied to others, by an equation or a sum of joints that an actuator pulls: so the fingers of a hand hold each other.
    fn is_tied(&self, joint: usize) -> bool {
        let m = &self.0;
        let id = i32::try_from(joint).unwrap_or(-1);
        let is_off =
            self.disables(mjtDisableBit::mjDSBL_EQUALITY) || self.disables(mjtDisableBit::mjDSBL_CONSTRAINT);
        let equates = |k: usize| {
            m.eq_type()[k] == MjtEq::mjEQ_JOINT
                && m.eq_active0()[k]
                && [m.eq_obj1id()[k], m.eq_obj2id()[k]].contains(&id)
        };
        let pulls = |tendon: usize| {
            let [first, count] = [m.tendon_adr()[tendon], m.tendon_num()[tendon]].map(|x| x.max(0) as usize);
            (first..first + count)
                .any(|k| m.wrap_type()[k] == MjtWrap::mjWRAP_JOINT && m.wrap_objid()[k] == id)
        };
        let by_equation = !is_off && (0..m.eq_type().len()).any(equates);
        let by_tendon = || (0..self.n_actuators()).filter_map(|id| self.tendon_of(id)).any(pulls);
        self.joint(joint).nv == 1 && (by_equation || by_tendon())
    }

    /// Whether a tendon is a sum of joints that no motor drives: the equations of those that motors drive do not have what it damps.
    pub(super) fn is_apart(&self, tendon: usize) -> bool {
        let m = &self.0;
        let [first, count] = [m.tendon_adr()[tendon], m.tendon_num()[tendon]].map(|x| x.max(0) as usize);
        (first..first + count).all(|k| {
            let joint = m.wrap_objid()[k];
            let drives = |id: usize| self.driven_joint(id).is_some() && m.actuator_trnid()[id][0] == joint;
            m.wrap_type()[k] == MjtWrap::mjWRAP_JOINT && !(0..self.n_actuators()).any(drives)
        })
    }

    fn motor(&self, id: usize, name: String, joint: &str) -> Motor {
        let m = &self.0;
        let order = m.actuator_ctrladr()[id].max(0) as usize;
        let gain = m.actuator_gainprm()[id][0];
        let bias = match m.actuator_biastype()[id] {
            MjtBias::mjBIAS_AFFINE => {
                let b = &m.actuator_biasprm()[id];
                [b[0], b[1], b[2]]
            }
            _ => [0.0; 3],
        };
        let clamps = m.actuator_ctrllimited()[order] && !self.disables(mjtDisableBit::mjDSBL_CLAMPCTRL);
        Motor {
            name,
            joint: joint.to_string(),
            order,
            command: command(gain, bias),
            gear: m.actuator_gear()[m.actuator_outadr()[id].max(0) as usize][0],
            gain,
            bias,
            control_range: clamps.then(|| m.actuator_ctrlrange()[order]),
            force_range: self.force_range(id, order),
            not_modelled: self.beyond_the_law(id),
        }
    }

    /// The file's own, and of a filtered control what the control's range allows: a filter does not overshoot.
    fn force_range(&self, id: usize, order: usize) -> Option<[f64; 2]> {
        let m = &self.0;
        let own = m.actuator_forcelimited()[id].then(|| m.actuator_forcerange()[id]);
        let is_filter = matches!(m.actuator_dyntype()[id], MjtDyn::mjDYN_FILTER | MjtDyn::mjDYN_FILTEREXACT)
            && m.actuator_gaintype()[id] == MjtGain::mjGAIN_FIXED
            && m.actuator_biastype()[id] == MjtBias::mjBIAS_NONE;
        if !is_filter || !m.actuator_ctrllimited()[order] {
            return own;
        }
        let ends = m.actuator_ctrlrange()[order].map(|u| m.actuator_gainprm()[id][0] * u);
        let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        Some(own.map_or([low, high], |own| [own[0].max(low), own[1].min(high)]))
    }

    /// Why an actuator's force is more than gain, control and bias.
    fn beyond_the_law(&self, id: usize) -> Option<String> {
        let m = &self.0;
        let kind = if m.actuator_gaintype()[id] != MjtGain::mjGAIN_FIXED {
            "a gain that depends on the state"
        } else if !matches!(m.actuator_biastype()[id], MjtBias::mjBIAS_NONE | MjtBias::mjBIAS_AFFINE) {
            "a bias that is not affine"
        } else if m.actuator_dyntype()[id] != MjtDyn::mjDYN_NONE {
            "dynamics of its own"
        } else if m.actuator_delay()[id] != 0.0 {
            "a delay"
        } else if m.actuator_gear()[m.actuator_outadr()[id].max(0) as usize][0] == 0.0 {
            "gear 0"
        } else if m.actuator_gainprm()[id][0] == 0.0 {
            "gain 0"
        } else if m.actuator_dampingpoly()[id].iter().any(|x| *x != 0.0) {
            "a damper that is not linear"
        } else {
            return None;
        };
        Some(kind.to_string())
    }
}

/// What the control means, by what the force does where the control is the joint's own position or velocity.
fn command(gain: f64, [_, position, velocity]: [f64; 3]) -> Command {
    if position == -gain && velocity == 0.0 {
        Command::Position
    } else if position == -gain {
        Command::Pd
    } else if position == 0.0 && velocity == -gain {
        Command::Velocity
    } else {
        Command::Effort
    }
}
