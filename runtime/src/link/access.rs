//! Slices and texts of messages. A peer may send any number as a length, so every length is clamped to the capacity.

use std::mem::offset_of;
use std::ops::Range;

use nearl_constraints::Kind;

use super::messages::*;
use super::schema::{Arrays, WORD};
use crate::snapshot::SnapshotError;

macro_rules! slices {
    ($message:ident { $($get:ident, $get_mut:ident : $field:ident [$count:ident];)* }) => {
        impl $message {
            $(
                #[doc = concat!("The used entries of `", stringify!($field), "`.")]
                pub fn $get(&self) -> &[f64] {
                    let count = (self.$count as usize).min(self.$field.len());
                    &self.$field[..count]
                }
                #[doc = concat!("The used entries of `", stringify!($field), "`, to be written.")]
                pub fn $get_mut(&mut self) -> &mut [f64] {
                    let count = (self.$count as usize).min(self.$field.len());
                    &mut self.$field[..count]
                }
            )*
        }
        impl Arrays for $message {
            const FIXED: usize = {
                let starts = [$(offset_of!($message, $field) / WORD),*];
                let (mut first, mut i) = (starts[0], 1);
                while i < starts.len() {
                    first = if starts[i] < first { starts[i] } else { first };
                    i += 1;
                }
                first
            };
            type Ranges = [Range<usize>; [$(stringify!($field)),*].len()];
            fn arrays(&self) -> Self::Ranges {
                [$({
                    let start = offset_of!($message, $field) / WORD;
                    start..start + (self.$count as usize).min(self.$field.len())
                }),*]
            }
        }
    };
}

slices!(StateMessage {
    q, q_mut: q[nq];
    v, v_mut: v[nv];
    obs, obs_mut: obs[n_obs];
    applied, applied_mut: applied[nu];
});
slices!(ActionMessage { action, action_mut: action[nu]; });
slices!(ProposalMessage { values, values_mut: values[n]; });
slices!(TransitionMessage {
    q, q_mut: q[nq];
    v, v_mut: v[nv];
    obs, obs_mut: obs[n_obs];
    proposal_q, proposal_q_mut: proposal_q[nq];
    proposal_v, proposal_v_mut: proposal_v[nv];
    target_q, target_q_mut: target_q[nq];
    target_v, target_v_mut: target_v[nv];
    action, action_mut: action[nu];
});

slices!(TickMessage {
    q, q_mut: q[nq];
    v, v_mut: v[nv];
    proposal_q, proposal_q_mut: proposal_q[nq];
    proposal_v, proposal_v_mut: proposal_v[nv];
    target_q, target_q_mut: target_q[nq];
    target_v, target_v_mut: target_v[nv];
    action, action_mut: action[nu];
    brake, brake_mut: brake[n_brake];
    multipliers, multipliers_mut: multipliers[n_active];
    slacks, slacks_mut: slacks[n_active];
});

slices!(RowsMessage {
    q_lower, q_lower_mut: q_lower[n_limits];
    q_upper, q_upper_mut: q_upper[n_limits];
    velocity, velocity_mut: velocity[n_limits];
    acceleration, acceleration_mut: acceleration[n_limits];
    effort, effort_mut: effort[n_limits];
});

impl RowsMessage {
    /// Name of the task.
    pub fn task_name(&self) -> String {
        let length = (self.task_length as usize).min(MAX_TASK);
        String::from_utf8_lossy(&self.task[..length]).into_owned()
    }

    /// Writes the name of the task, as much of it as there is room for.
    pub fn set_task_name(&mut self, name: &str) {
        let length = name.floor_char_boundary(MAX_TASK);
        self.task.fill(0);
        self.task[..length].copy_from_slice(&name.as_bytes()[..length]);
        self.task_length = length as u64;
    }

    /// Kind of each row; none for one of a single joint.
    pub fn row_kinds(&self) -> Vec<Option<Kind>> {
        let n = (self.n_kinds as usize).min(MAX_KINDS);
        self.kinds[..n]
            .iter()
            .map(|code| Kind::ALL.get(usize::from(*code).wrapping_sub(1)).copied())
            .collect()
    }

    /// Writes the kinds of the rows, as many as there is room for.
    pub fn set_row_kinds(&mut self, kinds: &[Option<Kind>]) {
        for (to, from) in self.kinds.iter_mut().zip(kinds) {
            *to = from.map_or(0, |kind| kind as u8 + 1);
        }
        self.n_kinds = kinds.len().min(MAX_KINDS) as u64;
    }

    /// Writes the limits of the degrees of freedom; none for a robot with more than a message holds.
    pub fn set_limits(&mut self, limits: &nearl_constraints::LimitSet) {
        let n = limits.velocity.len();
        if n > MAX_JOINTS {
            return;
        }
        self.n_limits = n as u64;
        self.q_lower_mut().copy_from_slice(&limits.q_lower);
        self.q_upper_mut().copy_from_slice(&limits.q_upper);
        self.velocity_mut().copy_from_slice(&limits.velocity);
        self.acceleration_mut().copy_from_slice(&limits.acceleration);
        self.effort_mut().copy_from_slice(&limits.effort);
    }

    /// Row names by number.
    pub fn row_names(&self) -> Vec<String> {
        let length = (self.length as usize).min(MAX_ROW_NAMES);
        String::from_utf8_lossy(&self.names[..length]).lines().map(str::to_owned).collect()
    }

    /// Writes the names of the rows, as many as there is room for; a line break within one becomes a space.
    pub fn set_row_names<S: AsRef<str>>(&mut self, names: &[S]) {
        self.length = write_names(names, &mut self.names) as u64;
    }
}

impl LimitsMessage {
    /// What is asked for.
    ///
    /// # Errors
    /// What is wrong with the text, in one line.
    pub fn moved(&self) -> Result<nearl_constraints::Moved, String> {
        let length = (self.length as usize).min(MAX_MOVED);
        serde_json::from_slice(&self.text[..length]).map_err(|e| crate::snapshot::one_line(&e))
    }

    /// Writes the text; false, and nothing is written, where there is no room for it.
    pub(crate) fn set_text(&mut self, text: &[u8]) -> bool {
        let Some(room) = self.text.get_mut(..text.len()) else { return false };
        room.copy_from_slice(text);
        self.length = text.len() as u64;
        true
    }
}

impl StateMessage {
    /// True if all used numbers are finite.
    pub fn is_finite(&self) -> bool {
        let all = |x: &[f64]| x.iter().all(|x| x.is_finite());
        all(self.q()) && all(self.v()) && all(self.obs()) && self.time.is_finite()
    }
}

impl ActionMessage {
    /// The last message of a runtime that ends in order: the plant keeps itself still from now on.
    pub fn farewell() -> ActionMessage {
        <ActionMessage as super::Message>::zeroed()
    }

    /// True for [`ActionMessage::farewell`]; states are numbered from 1.
    pub fn is_farewell(&self) -> bool {
        (self.state_seq, self.state_epoch, self.nu) == (0, 0, 0)
    }
}

/// The names of a list, each of which is followed by a line break.
fn read_names(bytes: &[u8]) -> Vec<String> {
    let end = bytes.iter().rposition(|&b| b == b'\n').unwrap_or(0);
    let text = String::from_utf8_lossy(&bytes[..end]);
    if text.is_empty() { Vec::new() } else { text.split('\n').map(str::to_owned).collect() }
}

/// Writes as many names as there is room for, and says how many bytes they take; a line break within one becomes a space.
fn write_names<S: AsRef<str>>(names: &[S], bytes: &mut [u8]) -> usize {
    bytes.fill(0);
    let mut at = 0;
    for name in names.iter().map(|name| name.as_ref().replace('\n', " ")) {
        let Some(room) = bytes.get_mut(at..=at + name.len()) else { break };
        room[..name.len()].copy_from_slice(name.as_bytes());
        room[name.len()] = b'\n';
        at += name.len() + 1;
    }
    at
}

impl AskedMessage {
    /// Names of what is asked for, in order; those beyond the capacity are missing (the hash covers all).
    pub fn entries(&self) -> Vec<String> {
        read_names(&self.names)
    }

    /// Writes the names, their number and their hash.
    pub fn set_entries<S: AsRef<str>>(&mut self, names: &[S]) {
        (self.n, self.hash) = (names.len() as u32, super::hash_names(names));
        write_names(names, &mut self.names);
    }
}

impl RobotMessage {
    /// Joint names in order; those beyond the capacity are missing (the hash covers all).
    pub fn joint_names(&self) -> Vec<String> {
        read_names(&self.names)
    }

    /// What the messages of this plant have, and how many of each, in the words of a sentence.
    pub(crate) fn sizes(&self) -> [(&'static str, u32); 4] {
        let observed = ("observation entries", self.n_obs);
        [("configuration entries", self.nq), ("velocities", self.nv), ("actions", self.nu), observed]
    }

    /// The first joint of `joints` that this plant has otherwise: its place, its name there, and its name here; `None` where a list ends.
    pub(crate) fn first_other_joint<'a>(
        &self,
        joints: &'a [String],
    ) -> (usize, Option<&'a str>, Option<String>) {
        let own = self.joint_names();
        let at = joints.iter().zip(&own).position(|(a, b)| a != b).unwrap_or(joints.len().min(own.len()));
        (at, joints.get(at).map(String::as_str), own.into_iter().nth(at))
    }

    /// Writes the joint names and their hash.
    pub fn set_joint_names<S: AsRef<str>>(&mut self, names: &[S]) {
        self.joints = super::hash_names(names);
        write_names(names, &mut self.names);
    }

    /// Writes the limits of the joints, as many as a message holds.
    pub fn set_limits(&mut self, limits: &nearl_constraints::LimitSet) {
        self.bits |= ROBOT_LIMITS;
        for (to, from) in [
            (&mut self.q_lower, &limits.q_lower),
            (&mut self.q_upper, &limits.q_upper),
            (&mut self.velocity, &limits.velocity),
            (&mut self.acceleration, &limits.acceleration),
            (&mut self.effort, &limits.effort),
        ] {
            to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
        }
    }

    /// True if the plant states its limits by number.
    pub fn states_limits(&self) -> bool {
        self.bits & ROBOT_LIMITS != 0
    }

    /// True if the plant waits for the action of every state.
    pub fn is_lockstep(&self) -> bool {
        self.bits & ROBOT_LOCKSTEP != 0
    }
}

nearl_controller::codes! {
    /// Answer to a snapshot, by reason.
    Verdict, "verdict" {
        Accepted = "accepted", "The snapshot is in use from the tick named in the receipt.", "Nothing to do.";
        Corrupt = "corrupt", "Not a snapshot, cut short, or the digest does not match the bytes.",
            "Send the file again as `nearl train` wrote it.";
        ForeignRobot = "foreign-robot", "Made for other joints, limits or actuators.",
            "Use a snapshot trained with the plant's robot file.";
        ForeignShape = "foreign-shape", "Made for another observation, other sizes or another layout.",
            "Use a snapshot trained for the plant's task.";
        ForeignPeriod = "foreign-period", "Made for another control period.",
            "Start the plant with the snapshot's task, or train with the plant's period.";
        NotFinite = "not-finite", "Holds numbers that are not finite or far too large, or gave such an answer on a trial state.",
            "Push an earlier snapshot: the training diverged.";
        Outdated = "outdated", "Not newer than the last one of the same sender.",
            "Give each push a higher version.";
        Superseded = "superseded", "A newer one came before this one was taken into use.",
            "Nothing to do, or push less often.";
        Other = "other", "Refused for the reason in the receipt's text.", "Read the text of the receipt.";
        RolledBack = "rolled-back", "Taken back after its swap: the robot no longer reached its targets, the one before is in use again.",
            "Train on with the transitions of that stretch, or raise the rollback factor if the rise was expected.";
        Looser = "looser-limits", "Its limits, or the way it keeps them, would allow more than those fixed when the loop was started.",
            "Train within the limits of the loop; only its operator can allow more, with `nearl run --limits FILE` or `--allow-looser`.";
    }
}

impl Verdict {
    /// What a refusal of the bytes themselves amounts to.
    pub fn of(error: &SnapshotError) -> Verdict {
        match error {
            SnapshotError::Malformed { .. }
            | SnapshotError::Digest { .. }
            | SnapshotError::Foreign { .. }
            | SnapshotError::MissingTensor { .. } => Verdict::Corrupt,
            SnapshotError::Shape { .. } => Verdict::ForeignShape,
            SnapshotError::Value { .. } | SnapshotError::Far { .. } | SnapshotError::Canary { .. } => {
                Verdict::NotFinite
            }
            _ => Verdict::Other,
        }
    }

    /// The verdict of a message; numbers this build does not know are `Other`.
    pub fn from_code(code: u32) -> Verdict {
        Verdict::ALL.get(code as usize).copied().unwrap_or(Verdict::Other)
    }
}

/// What stands at the end of a sentence that was cut.
const CUT: &str = "… (the whole sentence is a note in the report of the loop)";

impl ReceiptMessage {
    /// The answer to the snapshot with `header`.
    pub fn answer(header: &SnapshotHeader, verdict: Verdict, text: &str) -> ReceiptMessage {
        let mut receipt = <ReceiptMessage as super::Message>::zeroed();
        (receipt.trainer_epoch, receipt.version) = (header.header.epoch, header.version);
        receipt.set(verdict, text);
        receipt
    }

    /// The verdict.
    pub fn verdict(&self) -> Verdict {
        Verdict::from_code(self.verdict)
    }

    /// The sentence.
    pub fn text(&self) -> String {
        let length = (self.length as usize).min(MAX_TEXT);
        String::from_utf8_lossy(&self.text[..length]).into_owned()
    }

    /// Writes verdict and sentence; a sentence beyond the capacity is cut at a character, and says where it stands whole.
    pub fn set(&mut self, verdict: Verdict, text: &str) {
        let end = if text.len() > MAX_TEXT { CUT } else { "" };
        let mut length = text.len().min(MAX_TEXT - end.len());
        while !text.is_char_boundary(length) {
            length -= 1;
        }
        let text = format!("{}{end}", &text[..length]);
        self.verdict = verdict.code();
        self.length = text.len() as u32;
        self.text = [0; MAX_TEXT];
        self.text[..text.len()].copy_from_slice(text.as_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::super::Message;
    use super::*;

    #[test]
    fn lying_lengths_stay_inside() {
        let mut state = StateMessage::zeroed();
        state.nq = u32::MAX;
        state.n_obs = 1_000_000;
        assert_eq!(state.q().len(), MAX_JOINTS);
        assert_eq!(state.obs().len(), MAX_OBS);
        let mut receipt = ReceiptMessage::zeroed();
        receipt.length = u32::MAX;
        assert_eq!(receipt.text().len(), MAX_TEXT);
    }

    #[test]
    fn names_and_texts_survive_the_message() {
        let mut robot = RobotMessage::zeroed();
        assert!(robot.joint_names().is_empty());
        robot.set_joint_names(&["hip", "knee"]);
        assert_eq!(robot.joint_names(), ["hip", "knee"]);
        let mut receipt = ReceiptMessage::zeroed();
        receipt.set(Verdict::Corrupt, &"\u{e9}".repeat(200));
        assert_eq!(receipt.text(), "\u{e9}".repeat(200));
        receipt.set(Verdict::Corrupt, &"\u{e9}".repeat(600));
        let room = (MAX_TEXT - CUT.len()) / 2;
        assert_eq!(receipt.text(), format!("{}{CUT}", "\u{e9}".repeat(room)));
        assert_eq!(receipt.verdict(), Verdict::Corrupt);
    }

    #[test]
    fn row_names_that_do_not_fit_are_left_out_whole() {
        let mut rows = RowsMessage::zeroed();
        rows.set_row_names(&["elbow", "hand in\nfront of wall"]);
        assert_eq!(rows.row_names(), ["elbow", "hand in front of wall"]);
        rows.set_row_names(&vec!["x".repeat(1000); 20]);
        assert_eq!(rows.row_names(), vec!["x".repeat(1000); 8]);
        rows.length = u64::MAX;
        assert!(rows.row_names().len() >= 8);
    }

    #[test]
    fn what_viewers_are_told_fits_its_message_whatever_a_peer_says() {
        let mut rows = RowsMessage::zeroed();
        rows.set_task_name(&"\u{e9}".repeat(MAX_TASK));
        assert_eq!(rows.task_name(), "\u{e9}".repeat(MAX_TASK / 2));
        rows.set_task_name("arm");
        assert_eq!(rows.task_name(), "arm");
        rows.task_length = u64::MAX;
        assert!(rows.task_name().starts_with("arm"));
        rows.set_row_kinds(&[None, Some(Kind::Position), Some(Kind::VelocityProfile)]);
        assert_eq!(rows.row_kinds(), [None, Some(Kind::Position), Some(Kind::VelocityProfile)]);
        rows.kinds[0] = 255;
        rows.n_kinds = u64::MAX;
        assert_eq!((rows.row_kinds().len(), rows.row_kinds()[0]), (MAX_KINDS, None));
        rows.n_limits = u64::MAX;
        assert_eq!(rows.velocity().len(), MAX_JOINTS);
    }

    #[test]
    fn verdict_codes_are_their_index() {
        for (i, verdict) in Verdict::ALL.iter().enumerate() {
            assert_eq!(verdict.code() as usize, i);
        }
        assert_eq!(Verdict::from_code(99), Verdict::Other);
    }
}
