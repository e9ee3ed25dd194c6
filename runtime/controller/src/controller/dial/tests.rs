use super::*;

/// A joint of range [-1, 1] for each entry of `n`, with a motor of range [-2, 2].
fn dial(asked: f64, n: usize) -> Dial {
    let row = |dof: usize, side: f64| Row {
        dof,
        idx_q: dof,
        side,
        limit: side,
        near: 0.2,
        at: dof,
        towards: 2.0 * side,
        away: -2.0 * side,
    };
    let rows: Vec<Row> = (0..n).flat_map(|dof| [row(dof, -1.0), row(dof, 1.0)]).collect();
    let (margins, often) = (vec![0.0; 2 * n], vec![0.5 / n as f64; 2 * n]);
    Dial { asked, dt: 0.01, rows, margins, often, scale: 1.0, ticks: 0.0, acted: false, first: Vec::new() }
}

/// A tick that leads to `q`.
fn tick(dial: &mut Dial, q: &[f64]) {
    dial.bound(&vec![0.0; q.len()], &vec![0.0; q.len()], None, &mut vec![0.0; q.len()]);
    dial.learn(q);
}

/// Numbers in [0, 1).
fn draws(seed: u64) -> impl FnMut() -> f64 {
    let mut x = seed;
    move || {
        x = x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (x >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Three ticks worked out with forty decimals.
#[test]
fn an_update_is_the_one_of_the_page() {
    let mut dial = dial(0.1, 1);
    let by_hand = [
        (0.0, 1.0099962516398734, 0.499, 0.0),
        (1.5, 0.9200636926314633, 0.500002, 0.0381275928778015),
        (0.0, 0.9300524573768141, 0.499001996, 0.0362658543761776),
    ];
    for (q, scale, often, margin) in by_hand {
        tick(&mut dial, &[q]);
        assert!((dial.scale - scale).abs() < 1e-13, "{} {scale}", dial.scale);
        assert!((dial.often[1] - often).abs() < 1e-13, "{} {often}", dial.often[1]);
        assert!((dial.margins[1] - margin).abs() < 1e-13, "{} {margin}", dial.margins[1]);
        assert_eq!(dial.margins[0], 0.0);
    }
}

/// Where an episode begins nobody acted, and where a state was not measured nobody knows: neither is counted.
#[test]
fn only_what_an_action_led_to_is_counted() {
    let mut dial = dial(0.1, 1);
    dial.learn(&[1.5]);
    dial.bound(&[0.0], &[0.0], None, &mut [0.0]);
    dial.interrupt();
    dial.learn(&[1.5]);
    assert_eq!((dial.ticks, dial.margins[1]), (0.0, 0.0));
}

/// Far from its limit a motor does all it is asked for; near it, `1 - 2 m` of its range in that direction alone.
#[test]
fn a_motor_is_bounded_near_its_limit_alone() {
    let mut dial = dial(0.1, 1);
    dial.margins[1] = 0.75;
    let mut bounded = |q: f64, v: f64, proposed: Option<f64>, a: f64| {
        let mut action = [a];
        dial.bound(&[q], &[v], proposed.as_ref().map(std::slice::from_ref), &mut action);
        action[0]
    };
    assert_eq!(bounded(0.0, 0.0, Some(0.79), 2.0), 2.0);
    assert_eq!(bounded(0.0, 0.0, Some(0.81), 2.0), -1.0, "2 (1 - 2 * 0.75)");
    assert_eq!(bounded(0.95, 4.0, Some(0.0), 2.0), 2.0, "it will be at 0.99");
    assert_eq!(bounded(0.95, 6.0, Some(0.0), 2.0), -1.0, "it will be at 1.01");
    assert_eq!(bounded(0.95, 6.0, Some(0.0), -1.5), -1.5, "away from it");
    assert_eq!(bounded(0.95, 0.0, None, 2.0), -1.0, "a policy of actions");
    assert_eq!(bounded(-0.95, 0.0, None, -2.0), -2.0, "the other limit has no margin");
}

/// A plant whose residual is known: the joint ends at the limit and half of `a - e` beyond it, with `a` in [-2, 2] its action and `e` uniform
/// there. So it is outside in a share of `(a + 2) / 4 = 1 - m` of the ticks, and the margin for a share `p` is `1 - p`.
#[test]
fn the_share_reached_is_the_one_asked_for() {
    for asked in [0.1, 0.05, 0.01] {
        let (mut dial, mut draw, mut outside, mut margin) = (dial(asked, 1), draws(7), 0, 0.0);
        let (settling, counted) = (20_000, 100_000);
        for k in 0..settling + counted {
            let mut action = [2.0];
            dial.bound(&[0.0], &[0.0], Some(&[1.0]), &mut action);
            let q = 1.0 + 0.5 * (action[0] - 4.0 * draw() + 2.0);
            dial.learn(&[q]);
            if k >= settling {
                outside += u32::from(q > 1.0);
                margin += dial.margins[1] / f64::from(counted);
            }
        }
        let share = f64::from(outside) / f64::from(counted);
        assert!((share / asked - 1.0).abs() < 0.05, "asked {asked}, got {share}");
        assert!((margin - (1.0 - asked)).abs() < 0.02, "asked {asked}: margin {margin}");
    }
}

/// Two joints that are outside in the same ticks: the whole is what was asked for, and not the sum of the rows.
#[test]
fn rows_that_are_outside_together_count_once() {
    let (asked, mut dial, mut draw, mut outside) = (0.05, dial(0.05, 2), draws(11), 0);
    let (settling, counted) = (20_000, 100_000);
    for k in 0..settling + counted {
        let mut action = [2.0, 2.0];
        dial.bound(&[0.0; 2], &[0.0; 2], Some(&[1.0; 2]), &mut action);
        let e = 4.0 * draw() - 2.0;
        let q = action.map(|a| 1.0 + 0.5 * (a - e));
        dial.learn(&q);
        outside += u32::from(k >= settling && q.iter().any(|q| *q > 1.0));
    }
    let share = f64::from(outside) / f64::from(counted);
    assert!((share / asked - 1.0).abs() < 0.05, "got {share}");
}

/// What no motor keeps runs its margin to the end and says so; the others are as they are.
#[test]
fn what_cannot_be_had_is_said_by_row() {
    let mut dial = dial(0.01, 2);
    (0..2000).for_each(|_| tick(&mut dial, &[0.0, -1.5]));
    let ends: Vec<bool> = dial.margins().iter().map(|margin| margin.at_end).collect();
    assert_eq!(ends, [false, false, true, false]);
}

/// What is taken over goes on bit for bit, and numbers that are none harm nothing.
#[test]
fn what_was_learned_is_handed_on() {
    let (mut a, mut b, mut draw) = (dial(0.1, 2), dial(0.1, 2), draws(3));
    let mut state = || [2.2 * draw() - 1.1, 2.2 * draw() - 1.1];
    (0..500).for_each(|_| tick(&mut a, &state()));
    let mut memory = Vec::new();
    a.write_memory(&mut memory);
    assert_eq!(memory.len(), 1 + a.learned_len());
    b.set_memory(&memory);
    for _ in 0..500 {
        let q = state();
        tick(&mut a, &q);
        tick(&mut b, &q);
        assert!(a.learned() == b.learned());
    }
    b.take_learned(&vec![f64::NAN; b.learned_len()]);
    assert!(b.margins.iter().all(|m| *m == 0.0) && b.scale == SCALES.0);
}

/// The mean of environments; nothing of those that learned nothing, or of other rows.
#[test]
fn margins_of_environments_are_merged() {
    let merge = |all: &[&[f64]]| merge_margins(all.iter().copied());
    assert_eq!(merge(&[&[1.0, 0.0], &[0.0, 0.5]]), Some(vec![0.5, 0.25]));
    assert_eq!(merge(&[]), None);
    assert_eq!(merge(&[&[], &[]]), None);
    assert_eq!(merge(&[&[1.0], &[1.0, 2.0]]), None);
}
