//! One tick of a plant that keeps its own time: a robot's driver calls [`Exchange::exchange`] once in each control period.
//!
//! [`PlantRunner`](super::PlantRunner) drives a simulator on a time grid. A real robot often keeps the time, and its driver has a loop of its own.

use super::runner::STANDSTILL_POLL;
use super::{ActionMessage, LinkError, Message, PlantLink, Robot, RobotName, StateMessage, torn};
use crate::clock;

/// What the driver is to do in this period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Turn<'a> {
    /// Apply this action, computed from the state just sent: by the policy, or to brake with (Braking, Fault).
    Act(&'a [f64]),
    /// Apply the action before once more: none came in time. Where it is a position, that would stop the robot within a period: slow down instead.
    Hold(&'a [f64]),
    /// Bring the robot to rest: there is no loop, none answered for the watchdog's time, or it leaves braking to the plant.
    Brake,
}

/// The plant announces itself this often [ns].
const ANNOUNCE: u64 = 100_000_000;

/// Bytes of a name of a joint, or of an entry of the observation.
const LONGEST_NAME: usize = 255;

/// A plant's link with its watchdog.
pub struct Exchange {
    link: PlantLink,
    state: StateMessage,
    last: ActionMessage,
    /// Time without a fresh action after which the plant brakes [ns].
    watchdog: u64,
    last_fresh: u64,
    is_attached: bool,
    /// It was told to brake last: there is no action that could be held.
    brakes: bool,
    lockstep: bool,
    next_announce: u64,
}

impl Exchange {
    /// Opens the plant's topics and announces `robot`. After `watchdog` \[s\] without a fresh action the plant is told to brake.
    ///
    /// # Errors
    /// [`LinkError`]; a second plant of the name is refused.
    pub fn open(name: &RobotName, robot: &Robot, watchdog: f64) -> Result<Exchange, LinkError> {
        let announced = |reason: String| LinkError::Announced { name: name.clone(), reason };
        if robot.joints.is_empty() || robot.nq == 0 || robot.nu == 0 {
            let Robot { joints, nq, nu, .. } = robot;
            return Err(announced(format!(
                "has {} joints, {nq} configuration entries and {nu} entries of an action, and cannot be moved",
                joints.len()
            )));
        }
        let is_name = |name: &String| {
            !name.is_empty() && !name.contains(char::is_control) && name.len() <= LONGEST_NAME
        };
        for (what, names) in [("joint", &robot.joints), ("entry of its observation", &robot.observation)] {
            if let Some((i, odd)) = names.iter().enumerate().find(|(_, name)| !is_name(name)) {
                let shown: String = odd.escape_debug().take(20).collect();
                return Err(announced(format!(
                    "names {what} {i} `{shown}`, which is empty, longer than {LONGEST_NAME} bytes or no plain text"
                )));
            }
        }
        let link = PlantLink::open(name, robot)?;
        let mut state = StateMessage::zeroed();
        (state.nq, state.nv) = (robot.nq as u32, robot.nv as u32);
        (state.nu, state.n_obs) = (robot.nu as u32, robot.observation.len() as u32);
        Ok(Exchange {
            link,
            state,
            last: ActionMessage::zeroed(),
            watchdog: clock::nanoseconds(watchdog),
            last_fresh: 0,
            is_attached: false,
            brakes: true,
            lockstep: robot.lockstep,
            next_announce: 0,
        })
    }

    /// The state to be sent next: time, episode and `bits` are the driver's. The link's own numbers (header, tick, due, late, watchdog, and
    /// `STATE_BRAKED`) are filled in by [`Exchange::tick`].
    pub fn state(&mut self) -> &mut StateMessage {
        &mut self.state
    }

    /// The driver has braked by itself since the last exchange, or something else has held the robot, as an emergency stop does: the next state says so,
    /// and set points begin where the robot is.
    pub fn braked(&mut self) {
        self.brakes = true;
    }

    /// Sends what was measured (q, v, observation) and waits at most `patience` \[s\] for its action, which is taken as applied. An action of
    /// another size than the robot's is none.
    ///
    /// # Panics
    /// Where one of the three is not as long as the robot says.
    pub fn exchange(&mut self, q: &[f64], v: &[f64], obs: &[f64], patience: f64) -> Turn<'_> {
        let nu = self.state.nu as usize;
        let state = &mut self.state;
        let sizes = [("q", q.len(), state.nq), ("v", v.len(), state.nv), ("obs", obs.len(), state.n_obs)];
        for (what, have, need) in sizes {
            assert!(have == need as usize, "{what} has {have} entries, and the robot has {need}");
        }
        state.q[..q.len()].copy_from_slice(q);
        state.v[..v.len()].copy_from_slice(v);
        state.obs[..obs.len()].copy_from_slice(obs);
        let acts = match self.tick(patience) {
            Turn::Act(action) if action.len() == nu => Some(true),
            Turn::Hold(action) if action.len() == nu => Some(false),
            _ => None,
        };
        let Some(acts) = acts else {
            self.brakes = true;
            return Turn::Brake;
        };
        let action = self.last.action();
        self.state.applied[..nu].copy_from_slice(action);
        if acts { Turn::Act(action) } else { Turn::Hold(action) }
    }

    /// Sends the state and waits at most `patience` \[s\] for its action. Without a loop it does not wait at all, unless time stands still
    /// meanwhile (lockstep). Once shared memory was taken away it says [`Turn::Brake`] for good; another one is to be opened then, in another process.
    pub fn tick(&mut self, patience: f64) -> Turn<'_> {
        if torn::is_torn() {
            (self.is_attached, self.brakes) = (false, true);
            return Turn::Brake;
        }
        let now = clock::now();
        self.announce(now);
        self.state.due = now;
        self.state.set_braked(self.brakes);
        self.link.send_state(&mut self.state);
        let is_answered = self.wait(now + clock::nanoseconds(patience));
        // what is sent again while it waits is of the same tick
        self.state.tick += 1;
        if is_answered {
            self.last_fresh = clock::now();
            self.brakes = self.last.nu == 0;
            return if self.brakes { Turn::Brake } else { Turn::Act(self.last.action()) };
        }
        let is_alive = self.is_attached && clock::now() < self.last_fresh + self.watchdog;
        if is_alive && !self.brakes {
            self.state.late += 1;
            return Turn::Hold(self.last.action());
        }
        if !is_alive && std::mem::take(&mut self.is_attached) {
            self.state.watchdog += 1;
        }
        self.brakes = true;
        Turn::Brake
    }

    /// Says what the plant is, when that is due; whether it was.
    fn announce(&mut self, now: u64) -> bool {
        let is_due = now >= self.next_announce;
        if is_due {
            self.link.announce();
            self.next_announce = now + ANNOUNCE;
        }
        is_due
    }

    /// Whether the action of the state just sent came before `until`.
    fn wait(&mut self, until: u64) -> bool {
        loop {
            let header = self.state.header;
            if let Some(action) = self.link.newest_action() {
                let ours = action.state_epoch == header.epoch;
                if ours && action.is_farewell() {
                    self.is_attached = false;
                    return false;
                }
                if ours && action.state_seq == header.seq {
                    self.last = *action;
                    self.is_attached = true;
                    return true;
                }
                if ours && !self.is_attached {
                    // an answer to a state of before: there is a loop, which the next states are waited for
                    (self.is_attached, self.last_fresh) = (true, clock::now());
                }
            }
            let now = clock::now();
            if !self.is_attached {
                self.link.attend();
                if !self.lockstep {
                    return false;
                }
                // a loop that comes while time stands still waits to be told of the plant and of where it is
                if self.announce(now) {
                    self.link.send_state(&mut self.state);
                }
            }
            if now >= until {
                return false;
            }
            // While nobody has answered yet time stands still, and nothing comes too late.
            if self.is_attached {
                std::thread::yield_now()
            } else {
                clock::sleep_until(until.min(now + STANDSTILL_POLL))
            }
        }
    }

    /// Whether a loop answers.
    pub fn is_attached(&self) -> bool {
        self.is_attached
    }

    /// The robot's name.
    pub fn name(&self) -> &RobotName {
        self.link.name()
    }
}
