//! Bumps on a floor: where a sphere comes to rest by MuJoCo's contacts, beside the ground that a task reads; how they grow with a curriculum.

use crate::leg::{columns_of_a_run_that_resumes_bit_for_bit, env_of, leg, refuses_each};
use nearl_trainer::mj::{Model, ModelFormat, Options, Scene, Sim};
use nearl_trainer::rollout::stream;
use rand::RngExt;

const HEIGHT: f64 = 0.12;
const RADIUS: f64 = 0.01;

/// A small heavy sphere that can only rise and fall, on two rails that move it anywhere.
fn probe() -> Sim {
    let text = format!(
        "<mujoco><option timestep='0.001'/><worldbody><body name='probe'>\
        <joint name='x' type='slide' axis='1 0 0' damping='1e9'/><joint name='y' type='slide' axis='0 1 0' damping='1e9'/>\
        <joint name='z' type='slide' axis='0 0 1' damping='5'/><geom type='sphere' size='{RADIUS}' mass='1'/>\
        </body></worldbody></mujoco>"
    );
    let scene = Scene { floor: Some(0.8), bumps: Some(HEIGHT), ..Scene::default() };
    let model = Model::with_scene(&text, ModelFormat::Mjcf, None, Options::default(), &scene).expect("model");
    Sim::apart(&model).expect("simulation")
}

/// Height at which the sphere's lowest point comes to rest.
fn rest(sim: &mut Sim, x: f64, y: f64) -> f64 {
    sim.set_state(&[x, y, HEIGHT + RADIUS], &[0.0; 3]).expect("state");
    sim.step(2000).expect("steps");
    assert!(
        sim.qvel()[2].abs() < 1e-3 && (sim.qpos()[0] - x).abs() < 1e-4,
        "{:?} {:?}",
        sim.qpos(),
        sim.qvel()
    );
    sim.qpos()[2] - RADIUS
}

#[test]
fn a_sphere_rests_on_the_ground_that_is_told() {
    let mut sim = probe();
    let nominal = sim.model().physique();
    assert_eq!(nominal.bumps, [HEIGHT]);
    let mut rng = stream(4, 0);
    for share in [1.0, 0.5, 0.0] {
        let mut physique = nominal.clone();
        physique.bumps[0] *= share;
        sim.change(&physique).expect("change");
        let mut told: Vec<f64> = Vec::new();
        for _ in 0..60 {
            let [x, y] = [0, 1].map(|_| rng.random_range(-14.0..14.0));
            let (ground, rests) = (sim.ground(x, y), rest(&mut sim, x, y));
            // On a slope a sphere touches beside its lowest point, in a valley on both sides; at rest it sinks in by less than a millimetre.
            assert!(
                (-1e-3..0.3 * HEIGHT * share + 1e-3).contains(&(rests - ground)),
                "({x}, {y}): {rests}, {ground}"
            );
            let near = (rests - ground).abs() < 3e-3;
            told.push(if near { ground } else { f64::NAN });
        }
        let known: Vec<f64> = told.into_iter().filter(|ground| ground.is_finite()).collect();
        assert!(known.len() > 45, "{} of 60 rest within 3 mm", known.len());
        let highest = known.iter().copied().fold(0.0, f64::max);
        assert!(highest <= HEIGHT * share && highest >= 0.6 * HEIGHT * share, "{highest}");
    }
}

#[test]
fn the_floor_is_flat_at_the_start_and_beyond_the_bumps() {
    let sim = probe();
    for turn in 0..64 {
        let (y, x) = (f64::from(turn) * 0.1).sin_cos();
        assert_eq!(sim.ground(0.55 * x, 0.55 * y), 0.0);
        assert_eq!(sim.ground(30.0 * x, 30.0 * y), 0.0);
    }
    let mut rng = stream(5, 0);
    let heights: Vec<f64> =
        (0..4000).map(|_| sim.ground(rng.random_range(-14.0..14.0), rng.random_range(-14.0..14.0))).collect();
    let mean = heights.iter().sum::<f64>() / 4000.0;
    assert!((mean / HEIGHT - 0.5).abs() < 0.05, "heights between 0 and all of it: their mean is {mean}");
}

#[test]
fn bumps_are_drawn_for_an_episode_and_read_by_its_task() {
    let seen = "state.observation=[\"q.hip\", \"q.knee\", \"v.hip\", \"v.knee\", \"ground.foot\", \"x.foot\", \"y.foot\", \"z.foot\"]";
    let calm = ["commands={}", "pushes={}", "termination={}", "reward={ alive = 1.0 }", seen];
    let bumpy = [&calm[..], &["scene.floor={ friction = 0.9, bumps = 0.1 }", "random.bumps=\"0.5 * level\""]]
        .concat();
    let mut env = env_of(&leg(), &bumpy);
    env.reset(&mut stream(1, 0)).expect("reset");
    assert_eq!(env.sim().model().physique().bumps, [0.05]);
    let column = env.spec().notes.iter().position(|note| note == "random/bumps").expect("column");
    assert_eq!(env.notes()[column], 0.5);
    let (mut q, v) = (env.qpos().to_vec(), env.qvel().to_vec());
    (q[0], q[1]) = (5.03, -3.21);
    env.set_state(&q, &v).expect("state");
    let mut obs = [0.0; 8];
    env.observe(&mut obs);
    assert_eq!(obs[4], env.sim().ground(obs[5], obs[6]));
    assert!(obs[4] > 0.001 && obs[4] < 0.05, "{obs:?}");
}

#[test]
fn a_curriculum_of_bumps_resumes_bit_for_bit() {
    let columns = columns_of_a_run_that_resumes_bit_for_bit(&[
        "scene.floor={ friction = 0.9, bumps = 0.1 }",
        "random.bumps=\"level\"",
        "curriculum={ step = 0.1, up = \"length > 0.1\", down = \"length < 0.05\" }",
    ]);
    assert!(columns.iter().any(|column| column == "random/bumps"), "{columns:?}");
}

#[test]
fn what_cannot_be_is_refused_by_name() {
    refuses_each(&[
        ("scene.floor={ friction = 0.9, bumps = -0.1 }", &["scene.floor.bumps", "-0.1", "metres"]),
        ("random.bumps=\"level\"", &["random.bumps", "flat", "scene.floor.bumps"]),
    ]);
}
