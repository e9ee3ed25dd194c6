//! Every kind of limit, alone and all together, at every period and number of physics steps, kept under attack on invented arms.

use crate::attack_scenes::run::{Seen, attack};
use crate::attack_scenes::scene::{KINDS, SOFT, Scene};
use crate::common::arms::random_arm;
use crate::common::robot;
use nearl_constraints::limit::REGISTRY;
use nearl_constraints::*;
use std::sync::Mutex;

const PERIODS: [f64; 4] = [0.001, 0.002, 0.01, 0.02];
const SUB_STEPS: [u32; 3] = [0, 1, 5];

/// Ticks of each kind at each period and number of physics steps: 1.6e5 in all.
const TICKS: usize = 400;

/// Hard jerk with each kind it is kept together with.
const WITH_JERK: [&str; 8] = [
    "jerk+torque",
    "jerk+torque_speed",
    "jerk+locked",
    "jerk+frame",
    "jerk+frame_speed",
    "jerk+energy",
    "jerk+collision",
    "jerk+rows",
];

/// A new kind has to be measured (`examples/attack/meter.rs`) and attacked.
#[test]
fn every_kind_of_the_registry_is_attacked() {
    let joints = ["position", "velocity", "acceleration"];
    let attacked = |name: &str| KINDS.iter().chain(&SOFT).chain(&joints).any(|known| *known == name);
    let missing: Vec<&str> = REGISTRY.iter().map(|entry| entry.name).filter(|name| !attacked(name)).collect();
    assert!(missing.is_empty(), "nothing attacks {missing:?}: add it to examples/attack/scene.rs");
}

#[test]
fn every_kind_is_kept_alone_and_together() {
    let cells = KINDS.iter().chain(&WITH_JERK).flat_map(|kind| {
        PERIODS.iter().flat_map(move |dt| SUB_STEPS.iter().map(move |steps| (*kind, *dt, *steps)))
    });
    let cells = Mutex::new(cells.enumerate().collect::<Vec<_>>());
    let (ticks, held) = (Mutex::new(0), Mutex::new([0usize; 2]));
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some((k, (kind, dt, sub_steps))) = { cells.lock().unwrap().pop() } {
                    let arms = if WITH_JERK.contains(&kind) { 1 } else { 2 };
                    for arm in 0..arms {
                        let model = random_arm(1000 * arm + k as u64, 5 + arm as usize);
                        let settings = Settings { braking: Braking::Stored, ..Settings::new(dt, sub_steps) };
                        let scene = Scene::new(&model, "tool", kind);
                        let seen: Seen = attack(&model, &scene, &settings, TICKS, k as u64);
                        assert_eq!(
                            (seen.over, seen.alarms),
                            (0, 0),
                            "{kind}, {sub_steps} steps of {dt} s: {seen:?}"
                        );
                        let moves = seen.braked * 10 < seen.ticks * 9;
                        assert!(moves, "{kind}, {sub_steps} steps of {dt} s stands: {seen:?}");
                        *ticks.lock().unwrap() += seen.ticks;
                        let mut held = held.lock().unwrap();
                        *held = [held[0] + seen.slowed, held[1] + seen.braked];
                    }
                }
            });
        }
    });
    let (ticks, held) = (*ticks.lock().unwrap(), *held.lock().unwrap());
    println!("{ticks} ticks, {held:?} slowed and braked");
    assert!(ticks >= 160_000 && held[0] > 1000, "{ticks} {held:?}: this shows nothing");
}

/// An episode at the limit of the energy: what rounding lets it be beyond in a tick does not add up.
#[test]
fn what_stays_at_a_limit_does_not_creep_beyond_it() {
    let model = robot("ur5/ur5.urdf");
    let settings = Settings { braking: Braking::Stored, ..Settings::new(0.001, 0) };
    let seen = attack(&model, &Scene::new(&model, "tool0", "energy"), &settings, 2500, 1);
    println!("{seen:?}");
    assert!(seen.worst < 2.1e-10, "1e-10 of the speed is 2e-10 of the energy: {seen:?}");
}
