//! Messages whose numbers another program wrote.

use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use nearl_trainer::rollout_protocol::{self as rollout, Layout, ReplyMessage};

use crate::arm::*;
use crate::assert_sentence;

/// A message as it lies in shared memory.
pub fn bytes_of<M: Message>(message: &M) -> &[u8] {
    // SAFETY: a message is plain numbers without padding, for its whole size.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(message).cast::<u8>(), size_of::<M>()) }
}

/// The message that these bytes are; what is missing stays zero.
fn message<M: Message>(bytes: &[u8]) -> M {
    let mut message = M::zeroed();
    let length = bytes.len().min(size_of::<M>());
    // SAFETY: every bit pattern of a message is a value, and the length is within both.
    unsafe {
        std::ptr::copy_nonoverlapping(bytes.as_ptr(), std::ptr::from_mut(&mut message).cast::<u8>(), length)
    };
    message
}

/// Everything that reads a part of a message whose length the message says itself.
pub fn read_link(bytes: &[u8]) {
    let state: StateMessage = message(bytes);
    assert!(state.q().len() <= MAX_JOINTS && state.v().len() <= MAX_JOINTS && state.obs().len() <= MAX_OBS);
    let _ = state.is_finite();
    let action: ActionMessage = message(bytes);
    assert!(action.action().len() <= MAX_JOINTS);
    let _ = action.is_farewell();
    let transition: TransitionMessage = message(bytes);
    let _ = Mode::from_code(transition.mode);
    let receipt: ReceiptMessage = message(bytes);
    assert!(receipt.text().chars().count() <= MAX_TEXT);
    let _ = receipt.verdict();
    let robot: RobotMessage = message(bytes);
    assert!(robot.joint_names().len() <= MAX_NAMES + 1);
    let mut sequence = Sequence::default();
    sequence.accept(&state.header);
    assert!(!sequence.accept(&state.header), "the same message is never accepted twice");
}

/// A snapshot against a plant that says it is something else.
pub fn read_robot(bytes: &[u8]) {
    let robot: RobotMessage = message(bytes);
    if let Err(refusal) = Pilot::new(&snapshot(1, |_| {}), &robot) {
        assert_sentence(&refusal.text, &["plant", "snapshot"]);
    }
}

/// The loop meets states of the right sizes with any other number in them: every action is finite and within the motors.
pub fn with_core(fuzz: impl FnOnce(&dyn Fn(&[u8]))) {
    let first = stochastic(1);
    let name = RobotName::new("fuzz").expect("name");
    let robot = describe(&first.manifest, false).map(|r| r.message(&name).expect("message")).expect("robot");
    let controller = Pilot::new(&first, &robot).unwrap_or_else(|e| panic!("{}", e.text));
    let settings = CoreSettings {
        period: 1_000_000,
        sync: Sync::Plant,
        age_limit: 20_000_000,
        real_time: true,
        stop_speed: 1e-2,
        jump: RunSettings::default().jump,
        ramp: 50,
        modes: ModeLimits::default(),
        explore: Some(3),
        proposer: None,
    };
    let core = Core::new(settings, Box::new(Loaded { id: 0, controller }), 0, FaultPlan::default());
    let core = std::cell::RefCell::new((core, 0_u64));
    let effort = Panda::new().effort;
    fuzz(&|bytes| {
        let (core, tick) = &mut *core.borrow_mut();
        *tick += 1;
        let mut state: StateMessage = message(bytes);
        // The sizes and the sender are checked before the loop sees a state; time goes on.
        (state.nq, state.nv, state.n_obs) = (7, 7, 14);
        if *tick % 4 != 0 {
            state.header = Header { schema: 0, epoch: 1, seq: *tick, stamp: *tick * 1_000_000 };
        }
        core.swap(false);
        core.update(&Inputs {
            due: 0,
            begin: *tick * 1_000_000 + 10_000,
            stop: false,
            fresh: Some(&state),
            proposal: None,
        });
        core.close(*tick * 1_000_000 + 50_000);
        let record = &core.record;
        let action = &record.output.action[..record.output.nu as usize];
        assert!(action.iter().zip(&effort).all(|(a, e)| a.is_finite() && a.abs() <= *e), "{action:?}");
        assert_ne!(record.reason, Reason::Panic);
    });
}

/// A request for the server, a reply for the client.
pub fn read_rollout(bytes: &[u8]) {
    if let Err(error) = rollout::decode(bytes) {
        assert_sentence(&error.to_string(), &["request", "n_steps", "noise", "n_envs", "gamma"]);
    }
    let reply: ReplyMessage = message(bytes);
    assert!(reply.text().chars().count() <= rollout::MAX_REPLY_TEXT);
    let _ = reply.answer();
    let layout = Layout::of(&reply);
    let _ = (layout.width(), layout.find("ledger"), layout.find("none"));
}
