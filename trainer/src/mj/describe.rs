//! From MuJoCo's compiled model to a [`RobotDescription`]: whatever a file includes, replicates, takes from defaults or from meshes,
//! MuJoCo has already resolved.

use nearl_runtime::constraints::description::{
    Body, Frame, FrictionLaw, JointDescription, JointKind as Kind, Onset, Range, RobotDescription, Solid,
};
use nearl_runtime::constraints::geometry::{Placement, Shape};

use mujoco_rs::mujoco_c::{mjMINVAL, mjtDisableBit, mjtSolver};
use mujoco_rs::wrappers::mj_model::{MjtGeomBase, MjtObjBase, MjtWrap};

use super::{JointKind, MjError, Model, motors, pairs};

/// A velocity that friction does not look at: it would be stopped in this time \[s\].
const NEVER: f64 = 1e12;

/// The note of a file with equality constraints.
pub(crate) const EQUATIONS: &str = "equality constraints are not modelled";

impl Model {
    /// The robot as plain numbers, from which the dynamics of the controller are built. Its joints stand in MuJoCo's order.
    ///
    /// # Errors
    /// [`MjError::NoDescription`] with everything that the numbers cannot say and that would be wrong without: smooth forces other
    /// than linear springs and dampers of joints.
    pub fn describe(&self) -> Result<RobotDescription, MjError> {
        let beyond = self.beyond();
        if !beyond.is_empty() {
            return Err(MjError::NoDescription(beyond.join("; ")));
        }
        let mut robot = RobotDescription {
            name: self.name_of_model(),
            gravity: if self.disables(mjtDisableBit::mjDSBL_GRAVITY) {
                [0.0; 3]
            } else {
                let weight = 1.0 - self.held_weight().unwrap_or(0.0);
                self.0.opt().gravity.map(|g| weight * g)
            },
            bodies: (1..self.n_bodies()).map(|id| self.describe_body(id)).collect(),
            frames: self.sites(),
            solids: self.solids(),
            motors: Vec::new(),
            notes: self.notes(),
        };
        make_unique(robot.bodies.iter_mut().map(|body| &mut body.name));
        motors::add(self, &mut robot);
        Ok(robot)
    }

    pub(super) fn disables(&self, bit: mjtDisableBit) -> bool {
        self.0.opt().disableflags & bit as i32 != 0
    }

    /// The share of their weight that is held of all bodies that move (`gravcomp`): as if gravity were weaker. `None` where it is not the same.
    fn held_weight(&self) -> Option<f64> {
        // MuJoCo computes no passive force where springs and dampers are both switched off, and this is one.
        if self.disables(mjtDisableBit::mjDSBL_SPRING) && self.disables(mjtDisableBit::mjDSBL_DAMPER) {
            return Some(0.0);
        }
        let m = &self.0;
        let moves = |id: &usize| m.body_weldid()[*id] != 0 && m.body_mass()[*id] > 0.0;
        let mut shares = (1..self.n_bodies()).filter(moves).map(|id| m.body_gravcomp()[id]);
        let first = shares.next().unwrap_or(0.0);
        shares.all(|share| share == first).then_some(first)
    }

    fn describe_body(&self, id: usize) -> Body {
        let m = &self.0;
        let count = m.body_jntnum()[id].max(0) as usize;
        let first = m.body_jntadr()[id].max(0) as usize;
        let joints: Vec<_> = (first..first + count).map(|id| self.describe_joint(id)).collect();
        let is_free = joints.iter().any(|j| j.kind == Kind::Free);
        Body {
            name: self.body_name(id),
            parent: (m.body_parentid()[id] as usize).checked_sub(1),
            // The configuration of a free joint says where in the world the body is.
            placement: match is_free {
                true => Placement::IDENTITY,
                false => placement(m.body_pos()[id], m.body_quat()[id]),
            },
            mass: m.body_mass()[id],
            com: m.body_ipos()[id],
            inertia: turned(m.body_inertia()[id], rotation(m.body_iquat()[id])),
            joints,
        }
    }

    fn describe_joint(&self, id: usize) -> JointDescription {
        let (m, joint) = (&self.0, self.joint(id));
        let (q, v) = (joint.idx_q, joint.idx_v);
        let one = joint.nv == 1;
        let spring = if self.disables(mjtDisableBit::mjDSBL_SPRING) { 0.0 } else { m.jnt_stiffness()[id] };
        let damper = if self.disables(mjtDisableBit::mjDSBL_DAMPER) { 0.0 } else { m.dof_damping()[v] };
        // constraints of the solver are what friction and stops are made of
        let unconstrained = self.disables(mjtDisableBit::mjDSBL_CONSTRAINT);
        let friction = if self.disables(mjtDisableBit::mjDSBL_FRICTIONLOSS) || unconstrained {
            0.0
        } else {
            m.dof_frictionloss()[v]
        };
        let stops =
            m.jnt_limited()[id] && one && !self.disables(mjtDisableBit::mjDSBL_LIMIT) && !unconstrained;
        // MuJoCo takes a joint whose ends are swapped for one without limits.
        let [lower, upper] = m.jnt_range()[id];
        let swapped = one && lower > upper;
        let [low, high] = m.jnt_actfrcrange()[id];
        JointDescription {
            kind: match joint.kind {
                JointKind::Free => Kind::Free,
                JointKind::Ball => Kind::Ball,
                JointKind::Slide => Kind::Slide,
                JointKind::Hinge => Kind::Hinge,
            },
            axis: if one { m.jnt_axis()[id] } else { [0.0, 0.0, 1.0] },
            anchor: if joint.kind == JointKind::Free { [0.0; 3] } else { m.jnt_pos()[id] },
            reference: if one { m.qpos0()[q] } else { 0.0 },
            range: match (swapped, stops) {
                (true, _) => Range::Limited(lower, upper),
                (false, true) => Range::Limited(joint.range[0], joint.range[1]),
                (false, false) => Range::Unlimited,
            },
            velocity: None,
            effort: m.jnt_actfrclimited()[id].then(|| (-low).min(high).max(0.0)),
            damping: damper,
            stiffness: if one { spring } else { 0.0 },
            spring_reference: if one { m.qpos_spring()[q] } else { 0.0 },
            armature: m.dof_armature()[v],
            friction,
            friction_onset: (one && friction > 0.0).then(|| self.onset(v)),
            friction_law: FrictionLaw::Mujoco,
            ..JointDescription::new(&joint.name, Kind::Hinge)
        }
    }

    /// MuJoCo's impedance of the friction of dof `v`, with its names: `force = D (a + b v)`, `D = imp / (1 - imp) / diagApprox`,
    /// `b = 2 / (dmax timeconst)`, or `-solref[1] / dmax` where `solref` gives stiffness and damping by themselves.
    fn onset(&self, v: usize) -> Onset {
        let m = &self.0;
        let [dmin, dmax] = [0, 1].map(|k| m.dof_solimp()[v][k].clamp(1e-4, 0.9999));
        let imp = if m.dof_solimp()[v][2] <= mjMINVAL { 0.5 * (dmin + dmax) } else { dmin };
        let inertia = imp / (1.0 - imp) / m.dof_invweight0()[v];
        let [constant, damping] = match [m.dof_solref()[v][0], m.dof_solref()[v][1]] {
            // What MuJoCo takes where one is positive and the other is not.
            [a, b] if (a > 0.0) != (b > 0.0) => [0.02, 1.0],
            given => given,
        };
        if constant <= 0.0 {
            return Onset { inertia, time: (dmax / damping.abs()).min(NEVER), steps: 0.0 };
        }
        // No time constant is below two physics steps, of whatever length they are.
        let steps = if self.disables(mjtDisableBit::mjDSBL_REFSAFE) { 0.0 } else { dmax };
        Onset { inertia, time: 0.5 * dmax * constant, steps }
    }

    fn sites(&self) -> Vec<Frame> {
        let m = &self.0;
        let site = |id: usize| {
            Some(Frame {
                name: self.name(MjtObjBase::mjOBJ_SITE, id)?,
                body: (m.site_bodyid()[id] as usize).checked_sub(1),
                placement: placement(m.site_pos()[id], m.site_quat()[id]),
            })
        };
        (0..m.site_bodyid().len()).filter_map(site).collect()
    }

    /// Geoms that can touch something.
    fn solids(&self) -> Vec<Solid> {
        let m = &self.0;
        let touches = |id: &usize| pairs::is_solid(m, *id);
        let solid = |id: usize| {
            let [x, y, z] = m.geom_size()[id];
            let shape = match m.geom_type()[id] {
                MjtGeomBase::mjGEOM_PLANE => Some(Shape::HalfSpace),
                MjtGeomBase::mjGEOM_SPHERE => Some(Shape::Sphere { radius: x }),
                MjtGeomBase::mjGEOM_CAPSULE => Some(Shape::Capsule { radius: x, length: 2.0 * y }),
                MjtGeomBase::mjGEOM_CYLINDER => Some(Shape::Cylinder { radius: x, length: 2.0 * y }),
                MjtGeomBase::mjGEOM_BOX => Some(Shape::Box { size: [2.0 * x, 2.0 * y, 2.0 * z] }),
                _ => None,
            };
            let body = (m.geom_bodyid()[id] as usize).checked_sub(1);
            Solid { body, shape, placement: placement(m.geom_pos()[id], m.geom_quat()[id]) }
        };
        (0..m.geom_type().len()).filter(touches).map(solid).collect()
    }

    /// Smooth forces that no description can say: without them the equations of motion would be wrong.
    fn beyond(&self) -> Vec<String> {
        let m = &self.0;
        let mut beyond = Vec::new();
        let off = |id: &usize| {
            let group = m.actuator_group()[*id];
            (0..31).contains(&group) && (m.opt().disableactuator >> group) & 1 != 0
        };
        for id in (0..self.nu()).filter(off) {
            beyond.push(format!(
                "actuator '{}' is switched off with its group {} (actuatorgroupdisable): take that out of the file's option, or the actuator out of the \
                 file",
                self.actuator_name(id),
                m.actuator_group()[id]
            ));
        }
        let held = |id: &usize| m.body_gravcomp()[*id] != 0.0;
        if self.held_weight().is_none() {
            let all = (1..self.n_bodies()).filter(|id| m.body_weldid()[*id] != 0 && m.body_mass()[*id] > 0.0);
            let each: Vec<String> =
                all.map(|id| format!("'{}' {}", self.body_name(id), m.body_gravcomp()[id])).collect();
            beyond.push(format!(
                "gravcomp is not the same for all bodies that move ({}): give all of them the same, or none any",
                each.join(", ")
            ));
        }
        for (id, joint) in self.joints().iter().enumerate() {
            if m.jnt_actgravcomp()[id] && (1..self.n_bodies()).any(|id| held(&id)) {
                beyond.push(format!(
                    "joint '{}' has its weight held by its actuator (actuatorgravcomp): take that out",
                    joint.name
                ));
            }
        }
        for (id, joint) in self.joints().into_iter().enumerate() {
            let name = &joint.name;
            if joint.nv > 1 && m.jnt_stiffness()[id] != 0.0 && !self.disables(mjtDisableBit::mjDSBL_SPRING) {
                beyond.push(format!(
                    "joint '{name}' has {} dofs and a spring: set its stiffness to 0",
                    joint.nv
                ));
            }
            let bent = m.jnt_stiffnesspoly()[id].iter().chain(&m.dof_dampingpoly()[joint.idx_v]);
            if bent.into_iter().any(|x| *x != 0.0) {
                beyond.push(format!(
                    "joint '{name}' has a spring or damper that is not linear: make it linear"
                ));
            }
        }
        let damped = m.dof_damping().iter().any(|d| *d != 0.0);
        let euler = m.opt().integrator == mujoco_rs::mujoco_c::mjtIntegrator::mjINT_EULER as i32;
        if euler && damped && self.disables(mjtDisableBit::mjDSBL_EULERDAMP) {
            beyond.push("the option flag eulerdamp is off: take it out".to_string());
        }
        beyond
    }

    /// Geoms that another may touch: by their masks or a pair, of bodies that move against each other and are not joined.
    pub(crate) fn touching(&self) -> usize {
        if self.disables(mjtDisableBit::mjDSBL_CONTACT) || self.disables(mjtDisableBit::mjDSBL_CONSTRAINT) {
            return 0;
        }
        let m = &self.0;
        let parents_touch = self.disables(mjtDisableBit::mjDSBL_FILTERPARENT);
        let welded = |geom: usize| m.body_weldid()[m.geom_bodyid()[geom] as usize];
        let above = |body: i32| m.body_weldid()[m.body_parentid()[body as usize] as usize];
        let is_parent = |a: i32, b: i32| a != 0 && b != 0 && (a == above(b) || b == above(a));
        let may = |a: usize, b: usize| {
            let masks =
                m.geom_contype()[a] & m.geom_conaffinity()[b] | m.geom_contype()[b] & m.geom_conaffinity()[a];
            let (one, other) = (welded(a), welded(b));
            masks != 0 && one != other && (parents_touch || !is_parent(one, other))
        };
        let in_pair =
            |id: usize| [m.pair_geom1(), m.pair_geom2()].into_iter().flatten().any(|geom| *geom == id as i32);
        let n = m.geom_contype().len();
        (0..n).filter(|&a| in_pair(a) || (0..n).any(|b| may(a, b))).count()
    }

    /// What is the simulator's alone in every robot that has it, so that no note of the description speaks of it: contacts and sensors.
    pub(crate) fn simulated_alone(&self) -> Vec<String> {
        let m = &self.0;
        let touching = self.touching();
        let sensors = self.named(MjtObjBase::mjOBJ_SENSOR, m.nsensor() as usize);
        let mut left = Vec::new();
        if touching > 0 {
            left.push(format!(
                "contacts are the simulator's alone: {touching} geoms may touch something, and the model that limits are kept by knows no contact force"
            ));
        }
        if !sensors.is_empty() {
            left.push(format!(
                "sensors are not read, observations are computed from the state: {}",
                sensors.join(", ")
            ));
        }
        left
    }

    /// Names of all objects of a kind, or their numbers.
    fn named(&self, kind: MjtObjBase, n: usize) -> Vec<String> {
        let name = |id: usize| self.name(kind, id).map_or(format!("number {id}"), |name| format!("'{name}'"));
        (0..n).map(name).collect()
    }

    /// Tendons that pull, by what, and at which joints where they are sums of joints.
    fn pulling_tendons(&self) -> Vec<String> {
        let m = &self.0;
        let names = self.named(MjtObjBase::mjOBJ_TENDON, m.tendon_adr().len());
        let pulls = |(id, name): (usize, String)| {
            let by = [
                (
                    "spring",
                    m.tendon_stiffness()[id] != 0.0 || m.tendon_stiffnesspoly()[id].iter().any(|k| *k != 0.0),
                ),
                (
                    "damper",
                    m.tendon_damping()[id] != 0.0 || m.tendon_dampingpoly()[id].iter().any(|d| *d != 0.0),
                ),
                ("range", m.tendon_limited()[id]),
                ("dry friction", m.tendon_frictionloss()[id] != 0.0),
                ("armature", m.tendon_armature()[id] != 0.0),
                ("actuator", (0..self.n_actuators()).any(|actuator| self.tendon_of(actuator) == Some(id))),
            ];
            let by: Vec<&str> = by.into_iter().filter_map(|(what, acts)| acts.then_some(what)).collect();
            let [first, count] = [m.tendon_adr()[id], m.tendon_num()[id]].map(|x| x.max(0) as usize);
            let wrapped = (first..first + count).filter(|k| m.wrap_type()[*k] == MjtWrap::mjWRAP_JOINT);
            let joints: Vec<String> = wrapped
                .filter_map(|k| usize::try_from(m.wrap_objid()[k]).ok())
                .map(|joint| format!("'{}'", self.joint_name(joint)))
                .collect();
            let at = if joints.is_empty() { "what it spans".to_owned() } else { joints.join(", ") };
            (!by.is_empty()).then(|| format!("{name} pulls at {at} ({})", by.join(", ")))
        };
        names.into_iter().enumerate().filter_map(pulls).collect()
    }

    /// What the file says and the description does not.
    fn notes(&self) -> Vec<String> {
        let (m, mut notes) = (&self.0, Vec::new());
        let mut note = |present: bool, text: &str| {
            if present {
                notes.push(text.to_string());
            }
        };
        let equations = self.named(MjtObjBase::mjOBJ_EQUALITY, m.eq_type().len());
        let equations: Vec<String> =
            equations.into_iter().zip(m.eq_active0()).filter(|(_, on)| **on).map(|(name, _)| name).collect();
        note(
            !equations.is_empty(),
            &format!(
                "{EQUATIONS}: {}; limits may be left by what these pull at; take them out of the robot file, or leave margins",
                equations.join(", ")
            ),
        );
        let tendons = self.pulling_tendons();
        note(
            !tendons.is_empty(),
            &format!(
                "tendons are not modelled: {}; no limit of these joints, nor of those that they move, is promised; take them out of the robot file, or \
                 take idm kind = \"learned\" and see what is reached",
                tendons.join(", ")
            ),
        );
        note(m.nflex() > 0, "flexible bodies are not modelled");
        let several = |id: usize| self.joint(id).nv > 1 && m.dof_frictionloss()[self.joint(id).idx_v] != 0.0;
        note((0..m.jnt_type().len()).any(several), "frictionloss of free and ball joints is not modelled");
        let option = m.opt();
        let air = option.density != 0.0 || option.viscosity != 0.0;
        note(
            air,
            &format!(
                "fluid forces are not modelled (density {}, viscosity {}, wind {:?}): limits may be left by what they push; set these to 0, or leave margins",
                option.density, option.viscosity, option.wind
            ),
        );
        let balls = |id: usize| m.jnt_limited()[id] && self.joint(id).nv > 1;
        note((0..m.jnt_type().len()).any(balls), "limits of ball joints are not modelled");
        note(m.body_mocapid().iter().any(|id| *id >= 0), "mocap bodies are taken to stand still");
        note(self.disables(mjtDisableBit::mjDSBL_ACTUATION), "the file switches its actuators off");
        let early = |id: usize| {
            let stops = m.jnt_limited()[id] && self.joint(id).nv == 1 && m.jnt_margin()[id] > 0.0;
            stops.then(|| format!("'{}' by {}", self.joint_name(id), m.jnt_margin()[id]))
        };
        let early: Vec<String> = (0..m.jnt_type().len()).filter_map(early).collect();
        note(
            !early.is_empty() && !self.disables(mjtDisableBit::mjDSBL_LIMIT),
            &format!(
                "stops that act before the range ends (margin of a joint) are not modelled: {} [rad or m]; keep constraints.position that far inside",
                early.join(", ")
            ),
        );
        let rubs = m.dof_frictionloss().iter().any(|f| *f > 0.0);
        let slips = option.noslip_iterations > 0;
        note(rubs && slips, "noslip_iterations change dry friction, and that is not modelled; take them out");
        let exact = option.solver == mjtSolver::mjSOL_NEWTON as i32;
        note(
            rubs && !exact,
            "the simulator's solver is not Newton's, and its dry friction is then what is modelled to three or four digits; write solver=\"Newton\"",
        );
        let hurried = option.iterations < 20 || option.ls_iterations < 10 || option.tolerance > 1e-6;
        note(
            rubs && hurried,
            "the simulator's solver ends early (iterations, ls_iterations or tolerance), and its dry friction is then not what is modelled",
        );
        notes
    }

    fn name_of_model(&self) -> String {
        // SAFETY: MuJoCo's buffer of names begins with the model's own and every name ends with a zero.
        let name = unsafe { std::ffi::CStr::from_ptr(self.0.ffi().names) };
        name.to_string_lossy().into_owned()
    }
}

/// Nameless bodies take the name of a joint, which may be another body's.
fn make_unique<'a>(names: impl Iterator<Item = &'a mut String>) {
    let mut seen = std::collections::HashSet::new();
    for name in names {
        while !seen.insert(name.clone()) {
            name.push('_');
        }
    }
}

fn placement(position: [f64; 3], quaternion: [f64; 4]) -> Placement {
    Placement { position, rotation: rotation(quaternion) }
}

/// Rotation matrix by rows of a unit quaternion `w x y z`.
fn rotation([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// `R diag(moments) R'` as xx, xy, xz, yy, yz, zz.
fn turned(moments: [f64; 3], r: [[f64; 3]; 3]) -> [f64; 6] {
    let entry = |i: usize, j: usize| (0..3).map(|k| r[i][k] * moments[k] * r[j][k]).sum();
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}
