//! Limits on actions: what obeys, and nearest by the variational inequality of a projection on a convex set.

use crate::common::Random;
use crate::common::arms::small_arm;
use nearl_constraints::{ActionLimit, ActionSettings, ConstraintSettings, build_limits};

const N: usize = 6;

fn settings(text: &str) -> ActionSettings {
    toml::from_str(text).unwrap_or_else(|e| panic!("{text}: {e}"))
}

fn limit(text: &str) -> ActionLimit {
    ActionLimit::new(&settings(text), &small_arm(), &[], vec![(-1.0, 1.0); N]).unwrap()
}

/// By how much `a` breaks what the text asks for, from its formulas.
fn excess(s: &ActionSettings, v: &[f64], a: &[f64], before: Option<&[f64]>) -> f64 {
    let sum = |f: fn(f64, f64) -> f64| v.iter().zip(a).map(|(v, a)| f(*v, *a)).sum::<f64>();
    let over = |limit: Option<f64>, x: f64| limit.map_or(f64::NEG_INFINITY, |limit| x - limit);
    let rate = s.rate.as_ref().and_then(|rate| rate.of("j1", 0)).zip(before);
    let changes = rate.map_or(f64::NEG_INFINITY, |(rate, before)| {
        a.iter().zip(before).map(|(a, b)| (a - b).abs() - rate).fold(f64::NEG_INFINITY, f64::max)
    });
    let range = a.iter().map(|a| a.abs() - 1.0).fold(f64::NEG_INFINITY, f64::max);
    [
        over(s.power, sum(|v, a| (v * a).abs())),
        over(s.delivered, sum(|v, a| (v * a).max(0.0))),
        over(s.square, sum(|_, a| a * a)),
        changes,
        range,
    ]
    .into_iter()
    .fold(f64::NEG_INFINITY, f64::max)
}

/// `p` is nearest to `u` in a convex set exactly if `(u - p) (y - p) <= 0` for every `y` of the set.
#[test]
fn an_action_becomes_the_nearest_one_that_obeys() {
    let sets = [
        "power = 4.0",
        "delivered = 2.0",
        "square = 0.7",
        "rate = 0.15",
        "power = 4.0\nsquare = 0.7",
        "power = 5.0\ndelivered = 2.0\nsquare = 0.9",
        "square = 0.7\nrate = 0.3",
    ];
    for text in sets {
        let (s, mut limit, mut random) = (settings(text), limit(text), Random(7));
        let (mut before, mut moved): (Option<Vec<f64>>, u32) = (None, 0);
        for round in 0..200 {
            let v: Vec<f64> =
                (0..N).map(|i| if i == round % 9 { 0.0 } else { random.between(-9.0, 9.0) }).collect();
            let u: Vec<f64> = (0..N).map(|_| random.between(-1.2, 1.2_f64).clamp(-1.0, 1.0)).collect();
            let mut p = u.clone();
            let report = limit.project(&v, &mut p, true);
            let broken = excess(&s, &v, &p, before.as_deref());
            assert!(broken <= 1e-12, "{text}: {p:?} is beyond by {broken}");
            assert_eq!(report.target_violations, 0);
            assert_eq!(report.raw_violations > 0, excess(&s, &v, &u, before.as_deref()) > 1e-9, "{text}");
            if report.raw_violations == 0 {
                assert_eq!(p, u, "{text}: what obeys stays bit for bit");
            }
            moved += u32::from(report.moved > 0.0);
            for _ in 0..50 {
                // a point of the set: from anywhere towards the answer, until it obeys
                let far: Vec<f64> = (0..N).map(|_| random.between(-1.0, 1.0)).collect();
                let y = |t: f64| -> Vec<f64> { p.iter().zip(&far).map(|(p, f)| p + t * (f - p)).collect() };
                let t = (0..60)
                    .map(|k| 0.7_f64.powi(k))
                    .find(|t| excess(&s, &v, &y(*t), before.as_deref()) <= 0.0);
                let y = y(t.unwrap_or(0.0));
                let slope: f64 = u.iter().zip(&p).zip(&y).map(|((u, p), y)| (u - p) * (y - p)).sum();
                assert!(slope <= 1e-9, "{text}: {y:?} is nearer to {u:?} than {p:?}: {slope}");
            }
            before = s.rate.is_some().then_some(p);
        }
        assert!(moved > 100, "{text}: {moved}");
    }
}

#[test]
fn the_ball_is_that_of_the_text_book() {
    let mut a = [0.9, -0.9, 0.0, 0.3, 0.0, 0.0];
    let (u, norm) = (a, (0.9_f64 * 0.9 * 2.0 + 0.09).sqrt());
    let report = limit("square = 0.25").project(&[0.0; N], &mut a, true);
    for (a, u) in a.iter().zip(u) {
        assert!((a - 0.5 * u / norm).abs() < 1e-14, "{a} {u}");
    }
    assert!((report.moved - (norm - 0.5)).abs() < 1e-13, "{report:?}");
}

#[test]
fn without_hold_an_action_stays_and_what_it_breaks_is_counted() {
    let (v, mut a) = ([5.0; N], [1.0; N]);
    let report = limit("power = 4.0\nsquare = 0.7").project(&v, &mut a, false);
    assert_eq!((a, report.raw_violations, report.target_violations, report.moved), ([1.0; N], 2, 2, 0.0));
}

#[test]
fn a_rate_begins_anew_and_its_memory_travels() {
    let (mut one, mut other) = (limit("rate = 0.1"), limit("rate = 0.1"));
    let mut first = [0.9; N];
    one.project(&[0.0; N], &mut first, true);
    assert_eq!(first, [0.9; N], "no rate holds at the start");
    let mut memory = Vec::new();
    one.write_memory(&mut memory);
    assert_eq!(memory.len(), one.memory_len());
    other.set_memory(&memory);
    let (mut a, mut b) = ([-1.0; N], [-1.0; N]);
    one.project(&[0.0; N], &mut a, true);
    other.project(&[0.0; N], &mut b, true);
    assert!(a == b && a.iter().all(|a| (a - 0.8).abs() < 1e-15), "{a:?} {b:?}");
    one.forget();
    let mut again = [-1.0; N];
    one.project(&[0.0; N], &mut again, true);
    assert_eq!(again, [-1.0; N]);
    assert!(!limit("square = 1.0").remembers() && limit("square = 1.0").memory_len() == 0);
}

/// Where fewer joints are commanded than have motors, each entry is that of its own joint.
#[test]
fn entries_are_those_of_the_joints_that_are_commanded() {
    let unit = || vec![(-1.0, 1.0)];
    let mut of_last = ActionLimit::new(&settings("power = 1.0"), &small_arm(), &[N - 1], unit()).unwrap();
    let (mut v, mut a) = (vec![0.0; N], vec![1.0_f64]);
    v[N - 1] = 4.0;
    of_last.project(&v, &mut a, true);
    assert!((a[0] - 0.25).abs() < 1e-12, "4 rad/s times {} is 1", a[0]);
    (v, a) = (vec![4.0; N], vec![1.0]);
    v[N - 1] = 0.0;
    of_last.project(&v, &mut a, true);
    assert_eq!(a, [1.0], "of a joint that stands");
    let other = ActionLimit::new(&settings("power = 1.0"), &small_arm(), &[0, 1], unit()).unwrap_err();
    assert!(other.to_string().contains("action entry 0 drives no joint"), "{other}");
}

#[test]
fn what_cannot_be_kept_is_refused_by_name() {
    let refused = |text: &str, range: (f64, f64), n: usize| {
        ActionLimit::new(&settings(text), &small_arm(), &[], vec![range; n]).unwrap_err().to_string()
    };
    let unit = (-1.0, 1.0);
    for (text, range, n, words) in [
        ("power = 0.0", unit, N, "action.power is 0"),
        ("square = nan", unit, N, "action.square is NaN"),
        ("rate = -1.0", unit, N, "action.rate"),
        ("rate = { elbow = 0.1 }", unit, N, "'elbow'"),
        ("", unit, N, "action limits nothing"),
        ("power = 1.0\nrate = 0.1", unit, N, "action.rate beside power"),
        ("square = 1.0", (0.2, 1.0), N, "action entry 0 cannot be 0"),
        ("square = 1.0", unit, 9, "action entry 6 drives no joint"),
    ] {
        let error = refused(text, range, n);
        assert!(error.contains(words), "{text}: {error}");
    }
    let section: ConstraintSettings = toml::from_str("action = { power = 1.0 }").unwrap();
    let error = build_limits(&section, &small_arm()).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("[constraints.action]"), "a projector of states ignores nothing: {error}");
}
