//! The plant's ends of the links.

use nearl_constraints::LimitSet;

use super::board::{Board, BoardReader};
use super::owner::Owner;
use super::port::Outbox;
use super::service::Bus;
use super::*;

/// What a plant is; checked against the message capacities when the link opens.
#[derive(Clone, Debug)]
pub struct Robot {
    /// Joint names in the order of v.
    pub joints: Vec<String>,
    /// Names of the observation entries.
    pub observation: Vec<String>,
    /// Hash of the robot file's limits and the actuators' range, 0 if it says nothing about them.
    pub limits: u64,
    /// The limits it states by number, by velocity entry: a snapshot that allows more is refused. None if it states none.
    pub stated: Option<LimitSet>,
    /// Number of configuration entries.
    pub nq: usize,
    /// Number of velocity entries.
    pub nv: usize,
    /// Number of action entries.
    pub nu: usize,
    /// Control period \[s\].
    pub dt: f64,
    /// The plant waits for the action of every state instead of keeping real time.
    pub lockstep: bool,
}

impl Robot {
    /// A robot of joints with one position and one velocity each, on its own time, that states no limits.
    pub fn new(joints: &[&str], observation: &[&str], nu: usize, dt: f64) -> Robot {
        let names = |list: &[&str]| list.iter().map(ToString::to_string).collect();
        Robot {
            joints: names(joints),
            observation: names(observation),
            limits: 0,
            stated: None,
            nq: joints.len(),
            nv: joints.len(),
            nu,
            dt,
            lockstep: false,
        }
    }

    /// The message, or the number that does not fit.
    pub fn message(&self, name: &RobotName) -> Result<RobotMessage, LinkError> {
        let sizes = [
            ("configuration entries", self.nq, MAX_JOINTS),
            ("velocity entries", self.nv, MAX_JOINTS),
            ("action entries", self.nu, MAX_JOINTS),
            ("observation entries", self.observation.len(), MAX_OBS),
        ];
        for (what, count, limit) in sizes {
            if count > limit {
                return Err(LinkError::Capacity { name: name.clone(), what, count, limit });
            }
        }
        let announced = |reason: String| LinkError::Announced { name: name.clone(), reason };
        let twice = self.joints.iter().enumerate().find(|(i, joint)| self.joints[..*i].contains(joint));
        if let Some((_, joint)) = twice {
            return Err(announced(format!("names joint `{joint}` twice")));
        }
        if self.joints.len() > self.nv {
            let (joints, nv) = (self.joints.len(), self.nv);
            return Err(announced(format!("names {joints} joints, and has {nv} velocity entries")));
        }
        let mut message = RobotMessage::zeroed();
        message.set_joint_names(&self.joints);
        message.observation = hash_names(&self.observation);
        message.limits = self.limits;
        message.dt = self.dt;
        (message.nq, message.nv, message.nu) = (self.nq as u32, self.nv as u32, self.nu as u32);
        message.n_obs = self.observation.len() as u32;
        message.bits = if self.lockstep { ROBOT_LOCKSTEP } else { 0 };
        if let Some(stated) = &self.stated {
            message.set_limits(stated);
        }
        message.pid = std::process::id();
        Ok(message)
    }
}

/// Sends states, receives actions, and says what the plant is.
pub struct PlantLink {
    action: BoardReader<ActionMessage>,
    state: Board<StateMessage>,
    robot: Outbox<RobotMessage>,
    tally: Outbox<TallyMessage>,
    hello: RobotMessage,
    _owner: Owner,
    bus: Bus,
}

impl PlantLink {
    /// Opens the plant's topics and announces `robot`; a second plant of the same name is refused.
    pub fn open(name: &RobotName, robot: &Robot) -> Result<PlantLink, LinkError> {
        let hello = robot.message(name)?;
        let bus = Bus::join(name)?;
        let owner = bus.own("plant")?;
        let mut link = PlantLink {
            state: Board::create(name, bus.epoch())?,
            action: BoardReader::open(name),
            robot: bus.outbox()?,
            tally: bus.outbox()?,
            hello,
            bus,
            _owner: owner,
        };
        link.bus.reserve()?;
        link.announce();
        Ok(link)
    }

    /// Announces the plant again, for readers that came later, and looks for a runtime that came.
    pub fn announce(&mut self) -> bool {
        self.attend();
        self.robot.send(&mut self.hello)
    }

    /// Looks for a runtime that came. To be called now and then while none answers; costs a system call.
    pub fn attend(&mut self) {
        self.action.attend();
    }

    /// Sends a state; its number is in `message.header.seq` afterwards.
    pub fn send_state(&mut self, message: &mut StateMessage) {
        self.state.send(message);
    }

    /// Says what the plant counted so far.
    pub fn send_tally(&mut self, message: &mut TallyMessage) -> bool {
        self.tally.send(message)
    }

    /// The newest action, if it was not read before.
    pub fn newest_action(&mut self) -> Option<&ActionMessage> {
        self.action.newest()
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.bus.name()
    }
}
