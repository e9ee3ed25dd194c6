//! Settings by name: `nearl train TASK --preset strong`. They come before what `--set` says.

use std::str::FromStr;

/// A set of settings for every algorithm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// The paper's networks and batch.
    Paper,
    /// What a search with seeds did best with at a million steps.
    Strong,
    /// The same with a larger batch, for runs of five million steps and more.
    Long,
}

/// What one of them sets.
#[derive(Clone, Copy, Debug)]
pub struct RegisteredPreset {
    /// Which.
    pub preset: Preset,
    /// As it is written.
    pub name: &'static str,
    /// What it is, in one line.
    pub about: &'static str,
    /// The preset whose settings come first.
    based_on: Option<Preset>,
    /// Settings for every task.
    common: &'static [&'static str],
    /// Settings for some tasks, which come after them.
    tasks: &'static [(&'static str, &'static [&'static str])],
}

/// Every preset.
pub const PRESETS: &[RegisteredPreset] = &[
    RegisteredPreset {
        preset: Preset::Paper,
        name: "paper",
        about: "32 x 32 for all networks, the inverse model affine plus a residual; batch 2048, minibatch 64",
        based_on: None,
        common: &[
            "train.n_envs=16",
            "train.n_steps=128",
            "train.ppo.batch_size=64",
            "train.ppo.log_std=0.0",
            "train.nets={policy=[32,32],idm=[32,32],value=[32,32],discriminator=[32,32],activation=\"tanh\",idm_residual=true}",
        ],
        tasks: &[],
    },
    RegisteredPreset {
        preset: Preset::Strong,
        name: "strong",
        about: "64 x 64, 64 environments of 32 steps, minibatch 64, a first spread of e^-0.5; advantages anew before each pass, no further at 0.0225",
        based_on: None,
        common: &[
            "train.n_envs=64",
            "train.n_steps=32",
            "train.ppo.batch_size=64",
            "train.ppo.log_std=-0.5",
            "train.ppo.recompute_advantages=true",
            "train.ppo.target_kl=0.015",
            "train.nets.policy=[64,64]",
            "train.nets.value=[64,64]",
            "train.nets.discriminator=[64,64]",
        ],
        tasks: &[
            (
                "HalfCheetah-v5",
                &[
                    "train.n_envs=32",
                    "train.n_steps=128",
                    "train.ppo.batch_size=128",
                    "train.ppo.log_std=-1.0",
                    "train.ppo.lr=1e-3",
                    "train.ppo.target_kl=0.0",
                    "train.nets.idm_residual=true",
                    "train.pid2.lr=5e-4",
                    "train.pid2.warmup=16384",
                    "train.pid2.bound_weight=0.1",
                ],
            ),
            (
                "Hopper-v5",
                &["train.nets.idm_residual=true", "train.pid2.warmup=16384", "train.pid2.bound_weight=0.1"],
            ),
            (
                "Walker2d-v5",
                &[
                    "train.nets.idm=[32,32]",
                    "train.nets.idm_residual=true",
                    "train.pid2.warmup=16384",
                    "train.pid2.bound_weight=0.1",
                ],
            ),
            (
                "Ant-v5",
                &[
                    "train.gae_lambda=0.8",
                    "train.pid2.idm_policy_gradient=false",
                    "train.pid2.idm_threshold=0.05",
                    "train.pid2.null_space=true",
                    "train.pid2.alpha=1e-3",
                    "train.pid2.warmup=16384",
                    "train.pid2.bound_weight=0.1",
                ],
            ),
        ],
    },
    RegisteredPreset {
        preset: Preset::Long,
        name: "long",
        about: "`strong` with 64 environments of 256 steps and minibatches of 512, for five million steps and more",
        based_on: Some(Preset::Strong),
        common: &["train.n_envs=64", "train.n_steps=256", "train.ppo.batch_size=512"],
        tasks: &[],
    },
];

/// A name that no preset has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no preset '{0}'; give one of {1}")]
pub struct UnknownPreset(String, String);

impl Preset {
    /// As it is written.
    pub fn name(self) -> &'static str {
        self.entry().name
    }

    fn entry(self) -> &'static RegisteredPreset {
        let found = PRESETS.iter().find(|e| e.preset == self);
        found.unwrap_or_else(|| unreachable!("{self:?} has no line in the table"))
    }

    /// All names, with commas between them.
    pub fn names() -> String {
        PRESETS.iter().map(|e| e.name).collect::<Vec<_>>().join(", ")
    }

    /// What it sets for the task of this name, as `--set` would.
    pub fn overrides(self, task: &str) -> Vec<String> {
        let e = self.entry();
        let own = e.tasks.iter().filter(|(name, _)| *name == task).flat_map(|(_, set)| *set);
        let own = e.common.iter().chain(own).map(|set| (*set).to_string());
        let mut all = e.based_on.map_or_else(Vec::new, |base| base.overrides(task));
        all.extend(own);
        all
    }
}

impl FromStr for Preset {
    type Err = UnknownPreset;

    fn from_str(name: &str) -> Result<Self, UnknownPreset> {
        let found = PRESETS.iter().find(|e| e.name == name).map(|e| e.preset);
        found.ok_or_else(|| UnknownPreset(name.into(), Self::names()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::TrainSettings;
    use crate::tasks;

    #[test]
    fn every_preset_is_taken_by_every_task_and_stands_on_the_page() {
        let page = include_str!("../../docs/TRAINING.md");
        for e in PRESETS {
            assert_eq!(e.name.parse(), Ok(e.preset));
            assert!(
                page.contains(&format!("| `{}` | {} |", e.name, e.about)),
                "{} is not on the page",
                e.name
            );
            for task in tasks::names() {
                let manifest =
                    tasks::load_with(task, Some(e.preset), &[]).unwrap_or_else(|e| panic!("{task}: {e}"));
                TrainSettings::read(&manifest.task.train).unwrap_or_else(|e| panic!("{task}: {e}"));
            }
        }
    }

    #[test]
    fn what_is_set_beside_a_preset_wins() {
        let set = ["train.ppo.log_std=-0.7".to_string()];
        let manifest = tasks::load_with("Ant-v5", Some(Preset::Strong), &set).expect("task");
        let settings = TrainSettings::read(&manifest.task.train).expect("settings");
        assert_eq!((settings.ppo.log_std, settings.ppo.batch_size), (-0.7, 64));
        assert_eq!(settings.nets.idm, Vec::<usize>::new(), "what neither says stays the task file's");
        assert_eq!(
            "weak".parse::<Preset>().unwrap_err().to_string(),
            "no preset 'weak'; give one of paper, strong, long"
        );
        let long = tasks::load_with("HalfCheetah-v5", Some(Preset::Long), &[]).expect("task");
        let settings = TrainSettings::read(&long.task.train).expect("settings");
        assert_eq!((settings.n_envs, settings.n_steps, settings.ppo.batch_size), (64, 256, 512));
        assert_eq!((settings.ppo.lr, settings.pid2.lr), (1e-3, 5e-4), "what strong has for the task");
    }
}
