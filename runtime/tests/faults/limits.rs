//! Limits that somebody tries to loosen, and robots that cannot keep them.

use std::path::PathBuf;
use std::time::Duration;

use nearl_constraints::description::JointDescription;
use nearl_constraints::limit::AccelerationSettings;
use nearl_constraints::{Braking, Guard, Model, PerJoint, Soft};
use nearl_runtime::link::*;
use nearl_runtime::rt::*;
use nearl_runtime::task::IdmKind;
use nearl_runtime::{Manifest, PolicyKind, Snapshot};

use super::ROUNDING;
use super::stage::{Stage, kill};
use super::system::{command_of, until};
use crate::arm::*;
use crate::toy::{self, Name};

/// The panda's task with a frame and its speed, so that kinds beyond the joints are there to be loosened.
fn framed(m: &mut Manifest) {
    let constraints = "x = { frame = [{ frame = \"panda_hand\", half_space = { normal = [0, 0, -1], through = [0, 0, 0.05] }, braking = 2.0 }], \
         frame_speed = [{ frame = \"panda_hand\", limit = 1.0 }] }";
    let added: toml::Table = toml::from_str(constraints).unwrap();
    let table = added["x"].as_table().unwrap().clone();
    let settings: nearl_constraints::ConstraintSettings = table.try_into().unwrap();
    let own = &mut m.task.constraints;
    (own.frame, own.frame_speed) = (settings.frame, settings.frame_speed);
}

/// A change of a manifest.
type Change = fn(&mut Manifest);

/// What a pushed snapshot may try, and the word that names it in the refusal.
fn loosenings() -> Vec<(&'static str, Change)> {
    fn acceleration(m: &mut Manifest, limit: f64, braking: Option<f64>) {
        let all = PerJoint::All;
        m.task.constraints.acceleration = Some(AccelerationSettings::of(all(limit), braking.map(all)));
    }
    vec![
        ("velocity of joint 'panda_joint1'", |m| {
            m.task.constraints.velocity.as_mut().unwrap().scale = Some(1.0);
        }),
        ("velocity of joint 'panda_joint1' inf", |m| m.task.constraints.velocity = None),
        ("acceleration of joint 'panda_joint1' 300", |m| acceleration(m, 300.0, Some(10.0))),
        ("braking of joint 'panda_joint1' 11", |m| acceleration(m, 11.0, None)),
        ("highest position of joint 'panda_joint1'", |m| {
            m.task.constraints.position.as_mut().unwrap().margin = PerJoint::All(0.0);
        }),
        ("torque of joint 'panda_joint1'", |m| m.task.constraints.torque.as_mut().unwrap().scale = 1.0),
        ("frame_speed 'panda_hand': soft", |m| {
            m.task.constraints.frame_speed[0].soft = Some(Soft::default())
        }),
        ("braking = \"certified\"", |m| m.task.constraints.braking = Braking::Certified),
        ("frame_speed 'panda_hand': limit 1.5", |m| m.task.constraints.frame_speed[0].limit = 1.5),
        ("no limit of kind 'frame'", |m| m.task.constraints.frame.clear()),
        ("frame 'panda_hand': another 'half_space'", |m| {
            m.task.constraints.frame[0].half_space.as_mut().unwrap().through[2] = 0.01;
        }),
        ("physics steps", |m| m.task.time.sim_dt = 0.0005),
        ("another robot", |m| m.robot.bodies.iter_mut().for_each(|body| body.mass *= 1.5)),
        ("another robot: joint 'panda_joint1' has damping 60", |m| joints(m, |joint| joint.damping = 60.0)),
        ("another robot: joint 'panda_joint1' has dry friction 3", |m| {
            joints(m, |joint| joint.friction = 3.0)
        }),
        ("another robot: joint 'panda_joint1' has armature 0.5", |m| joints(m, |joint| joint.armature = 0.5)),
        // A period that is the plant's but for rounding is the loop's.
        ("velocity of joint 'panda_joint1'", |m| {
            m.task.time.dt += 1e-13;
            m.task.constraints.velocity.as_mut().unwrap().scale = Some(1.0);
        }),
    ]
}

fn joints(m: &mut Manifest, change: fn(&mut JointDescription)) {
    m.robot.bodies.iter_mut().flat_map(|body| &mut body.joints).for_each(change);
}

#[test]
fn fault_38_a_pushed_snapshot_may_tighten_the_limits_but_never_loosen_them() {
    let name = Name::new("pinned");
    let first = snapshot(1, framed);
    let file = File::new("pinned", &first);
    let plant = start_with(&name, &first, FaultPlan::default(), Duration::from_micros(300));
    let stop = Stop::new();
    let running = execute(&name, &file.0, &stop);
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    let mut version = 1;
    let mut push = |snapshot: &dyn Fn(u64) -> Snapshot| {
        version += 1;
        trainer.push(version, &snapshot(version).to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(60)).unwrap();
        (receipt.verdict(), receipt.text())
    };
    let with = |version: u64, change: fn(&mut Manifest)| {
        snapshot(version, |m| {
            framed(m);
            change(m);
        })
    };
    for (word, change) in loosenings() {
        let (verdict, text) = push(&|version| with(version, change));
        assert_eq!(verdict, Verdict::Looser, "{word}: {text}");
        assert!(text.contains(word), "'{word}' is not in: {text}");
    }
    // Motors of another range are another robot's, whatever the limits.
    let (verdict, text) = push(&|version| with(version, |m| m.action_upper[0] += 1.0));
    assert_eq!(verdict, Verdict::ForeignRobot, "{text}");
    assert!(text.contains("actuator ranges differ"), "{text}");
    let mut direct = with(0, |m| m.policy = PolicyKind::Direct);
    direct.networks.policy.layers[1].n_out = N;
    direct.networks.policy.layers[1].weight.truncate(16 * N);
    direct.networks.policy.layers[1].bias.truncate(N);
    direct.networks.policy_log_std = vec![-1.0; N];
    let (verdict, text) = push(&|version| {
        let mut direct = direct.clone();
        direct.manifest.version = version;
        direct
    });
    assert!(verdict == Verdict::Looser && text.contains("nothing is projected"), "{text}");
    let learned = |m: &mut Manifest| m.task.idm.kind = IdmKind::Learned;
    let text =
        Pinned::of(&first.manifest, "here").unwrap().admit(&with(2, learned).manifest).unwrap_err().text;
    assert!(text.contains("learned inverse model"), "{text}");

    let drives = |guard: Guard| {
        let mut manifest = first.manifest.clone();
        manifest.policy = PolicyKind::Direct;
        manifest.task.command =
            toml::from_str("interface = \"pd\"\nstiffness = 50.0\ndamping = 5.0").unwrap();
        manifest.task.constraints.guard = guard;
        manifest
    };
    let pinned = Pinned::of(&drives(Guard::Drive), "here").unwrap();
    assert!(pinned.admit(&drives(Guard::Drive)).is_ok());
    let text = pinned.admit(&drives(Guard::Off)).unwrap_err().text;
    assert!(text.contains("the forces of its drives are not bounded where those of the loop are"), "{text}");

    let tighter: fn(&mut Manifest) = |m| {
        m.task.constraints.velocity.as_mut().unwrap().scale = Some(0.5);
        m.task.constraints.frame_speed[0].limit = 0.5;
        m.task.constraints.energy = Some(toml::from_str("limit = 30.0").unwrap());
    };
    for change in [tighter, |_: &mut Manifest| {}] {
        let (verdict, text) = push(&|version| with(version, change));
        assert_eq!(verdict, Verdict::Accepted, "tighter, then what was pinned: {text}");
    }
    stop.request();
    let report = running.join().unwrap().unwrap();
    let (arm, _) = plant.end();
    assert_eq!((report.counters.swaps, report.refused_snapshots), (2, loosenings().len() as u64 + 2));
    assert_eq!(
        (report.modes["degraded"], report.modes["fault"], report.counters.stale),
        (0, 0, 0),
        "{report}"
    );
    assert!(arm.worst.iter().all(|e| *e <= ROUNDING), "position, velocity, torque: {:?}", arm.worst);
}

/// A robot takes the numbers of an action for what its driver was written for; a policy may be right in every limit and wrong in that.
#[test]
fn a_pushed_snapshot_whose_actions_mean_something_else_is_refused_by_both_names() {
    let (name, wide) = (Name::new("meaning"), [(-20.0, 20.0); N]);
    let of = |version: u64, command: &str, change: fn(&mut Manifest)| {
        snapshot(version, |m| {
            m.task.command = toml::from_str(command).unwrap();
            (m.action_lower, m.action_upper) = wide.into_iter().unzip();
            change(m);
        })
    };
    let (positions, velocities) = ("interface = \"position\"", "interface = \"velocity\"");
    let first = of(1, positions, |_| {});
    let file = File::new("meaning", &first);
    // A driver of one's own: it announces no digest of limits and commands, and takes whatever comes for positions.
    let robot = Robot { limits: 0, stated: None, ..describe(&first.manifest, true).unwrap() };
    let (link, over) = (PlantLink::open(&name.0, &robot).unwrap(), Stop::new());
    let plant = std::thread::spawn({
        let over = over.clone();
        move || {
            let mut arm =
                Panda { follows_positions: true, pause: Duration::from_micros(300), ..Panda::new() };
            PlantRunner::new(link, PlantSettings::lockstep(toy::DT)).unwrap().run(&mut arm, &over);
            arm
        }
    });
    // Not even where looser limits are let in: this is no limit.
    let stop = Stop::new();
    let running = execute_with(&name, &file.0, &stop, RunSettings { allow_looser: true, ..toy::settings() });
    let mut trainer = TrainerLink::open(&name.0).unwrap();
    trainer.wait_for_runtime(PATIENCE).unwrap();
    let mut push = |snapshot: Snapshot| {
        let version = snapshot.manifest.version;
        trainer.push(version, &snapshot.to_bytes()).unwrap();
        let receipt = trainer.wait_for_receipt(version, Duration::from_secs(60)).unwrap();
        (receipt.verdict(), receipt.text())
    };
    let one = "[interface]\npanda_joint1 = \"position\"\npanda_joint2 = \"velocity\"\npanda_joint3 = \"position\"\n\
               panda_joint4 = \"position\"\npanda_joint5 = \"position\"\npanda_joint6 = \"position\"\npanda_joint7 = \"position\"";
    let gains = "interface = \"pd\"\nstiffness = 800.0\ndamping = 40.0";
    let swapped: fn(&mut Manifest) = |m| {
        let (a, b) = (m.robot.motors[0].order, m.robot.motors[1].order);
        (m.robot.motors[0].order, m.robot.motors[1].order) = (b, a);
    };
    let other = [
        (
            of(2, velocities, |_| {}),
            "joint 'panda_joint1' is sent velocity [rad/s or m/s] where the loop sends position [rad or m], and 6 more",
        ),
        (
            of(3, one, |_| {}),
            "joint 'panda_joint2' is sent velocity [rad/s or m/s] where the loop sends position [rad or m]:",
        ),
        (
            of(4, "", |_| {}),
            "joint 'panda_joint1' is sent effort [N m or N] where the loop sends position [rad or m]",
        ),
        (of(5, gains, |_| {}), "pd target [rad or m], stiffness 800 N m/rad or N/m"),
        (
            of(6, positions, swapped),
            "action 0 is for joint 'panda_joint2' where the loop's is for 'panda_joint1'",
        ),
    ];
    let count = other.len() as u64;
    for (snapshot, words) in other {
        let (verdict, text) = push(snapshot);
        assert_eq!(verdict, Verdict::ForeignRobot, "{text}");
        assert!(text.contains(words), "'{words}' is not in: {text}");
    }
    let (verdict, text) = push(of(7, positions, |_| {}));
    assert_eq!(verdict, Verdict::Accepted, "{text}");
    stop.request();
    let report = running.join().unwrap().unwrap();
    over.request();
    let arm = plant.join().unwrap();
    assert_eq!((report.counters.swaps, report.refused_snapshots), (1, count), "{report}");
    assert!(arm.worst[1] <= ROUNDING, "{} rad/s beyond the speed limits", arm.worst[1]);
    // Gains of the robot's own drives, and the law of a motor, mean something else as well.
    let pd =
        |damping: f64| of(1, &format!("interface = \"pd\"\nstiffness = 800.0\ndamping = {damping}"), |_| {});
    let refused = |old: &Snapshot, new: &Snapshot| {
        Meaning::of(&old.manifest).unwrap().admit(&new.manifest).map_err(|refusal| refusal.text)
    };
    assert_eq!(refused(&pd(40.0), &pd(40.0)), Ok(()));
    let text = refused(&pd(40.0), &pd(41.0)).unwrap_err();
    assert!(text.contains("damping 41 N m s/rad") && text.contains("damping 40 N m s/rad"), "{text}");
    let geared = of(1, "", |m| m.robot.motors[3].gear = 2.0);
    let text = refused(&of(1, "", |_| {}), &geared).unwrap_err();
    assert!(text.contains("motor of joint 'panda_joint4' has gear 2 where the loop's has 1"), "{text}");
}

#[test]
fn the_operator_fixes_the_limits_by_a_file_or_lets_them_go() {
    let name = Name::new("limits-file");
    let first = snapshot(1, |_| {});
    let (file, folder) = (File::new("limits-file", &first), Scratch::new("limits-file"));
    let plant = start(&name, &first);
    let limits = folder.0.join("limits.toml");
    let with = |text: &str, allow_looser| {
        std::fs::write(&limits, text).unwrap();
        let settings =
            RunSettings { limits: Some(limits.clone()), allow_looser, ticks: Some(50), ..toy::settings() };
        run(&settings, &file.0, &name.0, &Stop::new()).map(|_| ()).map_err(|e| e.to_string())
    };
    let kept = "braking = \"stored\"\nposition = { margin = 0.01 }\ntorque = { scale = 0.95 }\nacceleration = { limit = 10.0 }\n";
    let slow = format!("[constraints]\n{kept}velocity = {{ scale = 0.5 }}\n");
    let error = with(&slow, false).unwrap_err();
    for word in ["velocity of joint 'panda_joint1'", "limits.toml", "rad/s", "--allow-looser"] {
        assert!(error.contains(word), "'{word}' is not in: {error}");
    }
    with(&slow, true).unwrap();
    with(&format!("[constraints]\n{kept}velocity = {{ scale = 0.9 }}\n"), false).unwrap();
    with(TASK, false).unwrap();
    for (text, word) in [
        ("[constraints]\nvelocty = { scale = 0.5 }\n", "did you mean 'velocity'"),
        ("name = \"x\"\n", "no section [constraints]"),
        ("[constraints]\nvelocity = { limit = { elbow = 1.0 } }\n", "elbow"),
    ] {
        let error = with(text, false).unwrap_err();
        assert!(error.contains(word) && error.contains("limits.toml"), "'{word}' is not in: {error}");
    }
    plant.end();
}

#[test]
fn a_snapshot_that_allows_more_than_its_plant_states_is_refused_by_joint() {
    let name = Name::new("stated");
    let plain = snapshot(1, |_| {});
    let slow = snapshot(1, |m| m.task.constraints.velocity.as_mut().unwrap().scale = Some(0.4));
    let (file, slower) = (File::new("stated", &plain), File::new("stated-slow", &slow));
    let plant = start(&name, &slow); // states 0.4 of the file's speeds
    let wish = RunSettings { ticks: Some(20), ..toy::settings() };
    let error = run(&wish, &file.0, &name.0, &Stop::new()).map(|_| ()).unwrap_err().to_string();
    let file_speed = Model::from_urdf_text(URDF).unwrap().velocity_limit()[0];
    for number in [0.9 * file_speed, 0.4 * file_speed] {
        assert!(error.contains(&number.to_string()), "{number} is not in: {error}");
    }
    assert!(error.contains("velocity of joint 'panda_joint1'") && error.contains("rad/s"), "{error}");
    run(&wish, &slower.0, &name.0, &Stop::new()).unwrap();
    let checks = nearl_runtime::doctor::examine(&slower.0, Some(name.0.as_str()));
    let said = &checks.iter().find(|c| c.check == "plant").unwrap().text;
    assert!(said.contains("velocity") && !said.contains("not compared"), "{said}");
    plant.end();
    // A plant that states nothing: what was not compared is said.
    let silent = Name::new("unstated");
    let robot = Robot { limits: 0, stated: None, ..describe(&slow.manifest, true).unwrap() };
    let link = PlantLink::open(&silent.0, &robot).unwrap();
    let over = Stop::new();
    let plant = std::thread::spawn({
        let over = over.clone();
        move || {
            PlantRunner::new(link, PlantSettings::lockstep(toy::DT)).unwrap().run(&mut Panda::new(), &over)
        }
    });
    let checks = nearl_runtime::doctor::examine(&file.0, Some(silent.0.as_str()));
    let said = &checks.iter().find(|c| c.check == "plant").unwrap().text;
    over.request();
    plant.join().unwrap();
    assert!(said.contains("not compared") && !said.contains("limits are the snapshot's"), "{said}");
}

/// Gravity alone, beside Pinocchio's own forces on a fine random sweep.
#[test]
fn fault_46_motors_too_weak_to_hold_the_arm_are_refused_by_joint_and_number() {
    let weak = snapshot(1, |m| m.task.constraints.torque.as_mut().unwrap().scale = 0.05);
    let file = File::new("weak", &weak);
    let checks = nearl_runtime::doctor::examine(&file.0, None);
    let found = checks.iter().find(|c| c.check == "holding").unwrap();
    assert_eq!(found.finding, nearl_runtime::doctor::Finding::Fail, "{}", found.text);
    let error = run(&toy::settings(), &file.0, &Name::new("weak").0, &Stop::new()).map(|_| ()).unwrap_err();
    let error = error.to_string();
    for text in [&found.text, &error] {
        for word in ["'panda_joint2'", "of its 4.4", "'panda_joint4'"] {
            assert!(text.contains(word), "'{word}' is not in: {text}");
        }
    }
    let parts = nearl_runtime::controller::Parts::new(&snapshot(1, |_| {}).manifest).unwrap();
    let (model, limits) = (&parts.model, parts.projector.limits());
    let period = nearl_constraints::Period::new(1e-3, 1);
    let loads = nearl_runtime::holding::heaviest(model, limits, parts.layout.controllable(), &period);
    let mut dynamics = nearl_constraints::Dynamics::new(model);
    let (rest, mut tau, mut worst) = (vec![0.0; N], vec![0.0; N], [0.0_f64; N]);
    for seed in 0..20_000 {
        let shares = weights(seed, N);
        let q: Vec<f64> = (0..N)
            .map(|i| {
                let share = f64::from(shares[i]).mul_add(0.6, 0.5).clamp(0.0, 1.0);
                limits.q_lower[i] + share * (limits.q_upper[i] - limits.q_lower[i])
            })
            .collect();
        dynamics.rnea(&q, &rest, &rest, &mut tau);
        (0..N).for_each(|i| worst[i] = worst[i].max(tau[i].abs()));
    }
    for load in &loads {
        let sampled = worst[load.dof];
        assert!(
            load.needed >= 0.999 * sampled - 1e-9,
            "{}: {} found, {sampled} sampled",
            load.joint,
            load.needed
        );
        dynamics.rnea(&load.q, &rest, &rest, &mut tau);
        assert!((tau[load.dof].abs() - load.needed).abs() < 1e-9, "it is reached where it says");
    }
    assert!(
        nearl_runtime::doctor::examine(&File::new("strong", &snapshot(1, |_| {})).0, None)
            .iter()
            .any(|c| c.check == "holding" && c.finding == nearl_runtime::doctor::Finding::Ok)
    );
}

#[test]
fn doctor_ends_at_any_period_and_never_calls_a_lack_ok() {
    for (dt, words) in [(1e-7, "is 0.0000001 s"), (1e-300, "is less than 0.000000001 s")] {
        let short = File::new("short", &snapshot(1, |m| (m.task.time.dt, m.task.time.sim_dt) = (dt, dt)));
        let checks = nearl_runtime::doctor::examine(&short.0, None);
        let words = format!("the period {words}, which no loop here keeps: give at least 0.00002 s");
        assert!(checks.iter().any(|c| c.check == "wake-up" && c.text == words), "{checks:?}");
        let is_power =
            |text: &str| text.as_bytes().windows(3).any(|w| w[0].is_ascii_digit() && &w[1..] == b"e-");
        assert!(!checks.iter().any(|c| is_power(&c.text)), "numbers are plain: {checks:?}");
    }
    for braking in [Braking::Certified, Braking::Stored] {
        let file = File::new("lack", &snapshot(1, |m| m.task.constraints.braking = braking));
        let checks = nearl_runtime::doctor::examine(&file.0, None);
        let text = &checks.iter().find(|c| c.check == "braking").unwrap().text;
        assert!(!text.contains("margin -") && !text.contains("by 0.00") && text.contains("stored"), "{text}");
    }
}

/// Ends by itself with its own code, and not by the number of ticks it never saw.
#[test]
fn fault_45_a_plant_or_a_loop_that_is_gone_ends_the_other_with_its_own_code() {
    let stage = Stage::new("gone");
    let plant = stage.start("plant");
    let patient = |settings| RunSettings { patience: 30.0, plant_patience: 0.5, ..settings };
    let stop = Stop::new();
    let settings = patient(RunSettings { seconds: Some(1e6), ..toy::settings() });
    let running = execute_with(&stage.name, &stage.file(), &stop, settings);
    let mut viewer = stage.viewer();
    until("the arm moves", || viewer.health().is_some_and(|h| h.tick > 50));
    kill(plant);
    let report = running.join().unwrap().unwrap();
    assert_eq!(report.reason, Reason::PlantGone, "{report}");

    // One in lockstep may take its time, and is gone as soon as it has left, though its process lives.
    let left = Name::new("left");
    let plant = PlantLink::open(&left.0, &toy::robot(true)).unwrap();
    let plant = std::thread::spawn(move || {
        let settings = PlantSettings { ticks: Some(50), ..PlantSettings::lockstep(toy::DT) };
        PlantRunner::new(plant, settings).unwrap().run(&mut toy::PointMass::default(), &Stop::new())
    });
    let settings = RunSettings { plant_patience: 0.5, ..toy::settings() };
    let report = toy::LoopThread::start(&left, settings, |_| {}).join();
    assert_eq!((report.reason, plant.join().unwrap().ticks), (Reason::PlantGone, 50), "{report}");

    // The wall's time counts: a plant that makes a tenth of its ticks does not make the run ten times as long.
    let slow = Name::new("slow-wall");
    let first = snapshot(1, |_| {});
    let link = PlantLink::open(&slow.0, &describe(&first.manifest, false).unwrap()).unwrap();
    let (over, file) = (Stop::new(), File::new("slow-wall", &first));
    let plant = std::thread::spawn({
        let over = over.clone();
        move || {
            let mut plant = Panda { pause: Duration::from_millis(10), ..Panda::new() };
            PlantRunner::new(link, PlantSettings::simulator(toy::DT)).unwrap().run(&mut plant, &over)
        }
    });
    let settings = RunSettings { seconds: Some(0.5), ..toy::settings() };
    let report = run(&settings, &file.0, &slow.0, &Stop::new()).unwrap();
    over.request();
    plant.join().unwrap();
    assert!(report.ticks < 500 && report.reason == Reason::Stop, "{report}");

    // The plant's side: a runtime that is killed is named.
    let deserted = Name::new("deserted");
    let link = PlantLink::open(&deserted.0, &toy::robot(false)).unwrap();
    let settings = PlantSettings { loop_patience: Some(5.0), ..PlantSettings::simulator(toy::DT) };
    let plant = std::thread::spawn(move || {
        let mut body = toy::PointMass { q: 1.0, ..toy::PointMass::default() };
        (PlantRunner::new(link, settings).unwrap().run(&mut body, &Stop::new()), body.braked)
    });
    let mut runtime = command_of("runtime", &deserted).spawn().unwrap();
    let mut viewer = TrainerLink::open(&deserted.0).unwrap();
    until("the loop runs", || viewer.health().is_some_and(|h| h.tick > 100));
    runtime.kill().unwrap();
    runtime.wait().unwrap();
    let (report, braked) = plant.join().unwrap();
    assert!(report.loop_gone && report.watchdog == 1 && braked > 0, "{report:?}");
}

/// Without a runtime a simulator keeps its own time: a few looks for one in a tick, not hundreds.
#[test]
fn a_plant_alone_looks_for_a_runtime_a_few_times_a_tick() {
    let name = Name::new("alone");
    let link = PlantLink::open(&name.0, &toy::robot(false)).unwrap();
    let settings = PlantSettings { ticks: Some(300), ..PlantSettings::simulator(toy::DT) };
    let report = PlantRunner::new(link, settings).unwrap().run(&mut toy::PointMass::default(), &Stop::new());
    assert_eq!((report.ticks, report.braked, report.watchdog), (300, 300, 0));
    assert!(report.looks <= 4 * report.ticks, "{report:?}");
}

/// In lockstep time stands still without a runtime: a look every millisecond is enough, and the first runtime is served all the same.
#[test]
fn a_plant_whose_time_stands_still_looks_for_a_runtime_now_and_then() {
    let name = Name::new("standstill");
    let link = PlantLink::open(&name.0, &toy::robot(true)).unwrap();
    let settings = PlantSettings { loop_patience: Some(0.5), ..PlantSettings::lockstep(toy::DT) };
    let report = PlantRunner::new(link, settings).unwrap().run(&mut toy::PointMass::default(), &Stop::new());
    assert!(report.loop_gone && report.ticks == 0, "{report:?}");
    assert!((50..=510).contains(&report.looks), "{report:?}");
}

/// A log is a record: what is there stays, whatever is started again with the same name.
#[test]
fn fault_44_a_log_that_is_there_is_never_written_over() {
    let (name, folder) = (Name::new("log-again"), Scratch::new("log-again"));
    let plant = toy::PlantThread::start(&name, toy::PointMass::default(), PlantSettings::lockstep(toy::DT));
    let log = folder.0.join("arm.mcap");
    let mut seen: Vec<(PathBuf, Vec<u8>)> = Vec::new();
    for again in ["arm.mcap", "arm-2.mcap", "arm-3.mcap"] {
        let settings = RunSettings { ticks: Some(20), log: Some(log.clone()), ..toy::settings() };
        let report = toy::LoopThread::start(&name, settings, |_| {}).join();
        let written = folder.0.join(again);
        assert_eq!(report.log.as_deref(), Some(written.as_path()));
        assert!(seen.iter().all(|(path, bytes)| std::fs::read(path).unwrap() == *bytes));
        seen.push((written.clone(), std::fs::read(&written).unwrap()));
    }
    plant.end();
}
