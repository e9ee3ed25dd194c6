//! `nearl demos record` as a user starts it: behind limits that the run did not have, and of its better episodes alone.

use std::path::Path;

use crate::common::*;
use nearl_trainer::demos::Demonstrations;
use serde_json::Value;

/// The back foot of HalfCheetah turns from -0.4 to 0.785 rad, as `half_cheetah.xml` has it.
const BFOOT: (&str, [f64; 2]) = ("q.bfoot", [-0.4, 0.785]);

fn record(out: &Path, more: &[&str]) -> Process {
    let expert = repository().join("results/imitation/experts/HalfCheetah-v5.safetensors");
    let (expert, out) = (expert.display().to_string(), out.display().to_string());
    Process::nearl(&[&["demos", "record", &expert, "--out", &out, "--json"], more].concat())
}

fn returns(told: &Value) -> Vec<f64> {
    told["returns"].as_array().expect("returns").iter().map(|r| r.as_f64().expect("a number")).collect()
}

/// Share of the recorded states in which the back foot is outside its range.
fn outside(file: &Path) -> f64 {
    let demos = Demonstrations::load(file).expect("demonstrations");
    let (name, [low, high]) = BFOOT;
    let (at, width) = (demos.names.iter().position(|n| n == name).expect(name), demos.names.len());
    let states = demos.episodes.iter().flat_map(|e| e.observations.chunks_exact(width));
    let (out, all) =
        states.fold((0, 0), |(out, all), s| (out + usize::from(!(low..=high).contains(&s[at])), all + 1));
    f64::from(u32::try_from(out).expect("few")) / f64::from(all)
}

#[test]
fn episodes_are_recorded_behind_limits_of_their_own_and_the_better_ones_kept() {
    let folder = tempfile::tempdir().expect("folder");
    let (free, guarded, best) =
        (folder.path().join("free.npz"), folder.path().join("guarded.npz"), folder.path().join("best.npz"));
    let guard = ["--episodes", "2", "--set", "constraints.guard=\"simulator\""];
    record(&free, &["--episodes", "1"]).json();
    let all = returns(&record(&guarded, &guard).json());
    assert!(outside(&free) > 0.05, "the policy leans on the stop: {}", outside(&free));
    assert_eq!(outside(&guarded), 0.0, "behind the guard it does not");

    let (least, most) = (all[0].min(all[1]), all[0].max(all[1]));
    let between = format!("{}", 0.5 * (least + most));
    let kept = returns(&record(&best, &[&guard[..], &["--at-least", &between]].concat()).json());
    assert_eq!(kept, [most], "the better of {all:?}");
    assert_eq!(Demonstrations::load(&best).expect("demonstrations").episodes.len(), 1);

    let again = record(&best, &["--episodes", "1"]).output();
    let said = String::from_utf8_lossy(&again.stderr).into_owned();
    assert!(!again.status.success() && said.contains("is there already"), "{said}");
    assert_eq!(Demonstrations::load(&best).expect("demonstrations").episodes.len(), 1, "kept");

    let none = folder.path().join("none.npz");
    let refused = record(&none, &["--episodes", "1", "--at-least", "1e9"]).output();
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(said.contains("--at-least 1000000000") && said.contains("ask for less"), "{said}");
    assert!(!refused.status.success() && !none.exists());
    let refused = record(&none, &["--set", "idm.kind=learned"]).output();
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        said.contains("--set idm.kind=learned: recording changes limits and what is simulated"),
        "{said}"
    );
}
