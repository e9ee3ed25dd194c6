//! `[train]` of the task file: how experience is collected, and the learner's own sections.

use crate::demos::DemoSettings;
use crate::learn::{CostSettings, NearlSettings, NetSettings, Pid2Settings, PpoSettings};
use nearl_runtime::task::suggest;
use serde::{Deserialize, Serialize};

/// How the unit of a proposed change is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ChangeScale {
    /// Standard deviation of the observed changes of state.
    #[default]
    Running,
    /// What the limits allow in one policy period: `a_max T` for velocities, `v_max T` for positions.
    Limits,
}

/// What is Gaussian: a deterministic or a stochastic meta policy, for the algorithms that propose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Exploration {
    /// `Action` where the inverse model is learned, `Proposal` where it is analytic.
    #[default]
    Auto,
    /// Deterministic meta policy, Gaussian action (Eq. 1 of the paper); needs a learned inverse model.
    Action,
    /// Stochastic meta policy; with a learned inverse model the action is Gaussian too. The only choice with analytic
    /// inverse dynamics. The ratio has as many dimensions as the state: expect slower learning.
    Proposal,
}

/// `[train]`. Unknown keys are errors.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Parallel environments.
    pub n_envs: usize,
    /// Policy steps each environment collects before an update; the batch is `n_envs n_steps`.
    pub n_steps: usize,
    /// Discount per policy step.
    pub gamma: f64,
    /// Lambda of generalised advantage estimation.
    pub gae_lambda: f64,
    /// Divide rewards by the running standard deviation of the discounted return.
    pub scale_reward: bool,
    /// Lower the learning rates of policy and value linearly over the run.
    pub anneal: bool,
    /// What is left of them at its end.
    pub anneal_to: f64,
    /// Policy and value see observations less their running mean, in units of their standard deviation.
    pub normalise_obs: bool,
    /// Unit of a proposed change.
    pub change_scale: ChangeScale,
    /// What is Gaussian.
    pub exploration: Exploration,
    /// Project while collecting (Algorithm 2, line 8). Off: the raw proposal becomes the target in training, and the
    /// constraints act in deployment only (a controller that loads the snapshot always projects; `nearl eval --compare
    /// raw,projected` shows both).
    pub project_in_training: bool,
    /// Share of the run over which limits come in: that of the environments that project while collecting rises linearly from none to all.
    pub limits_in: f64,
    /// The learner's reward is lowered by this for each unit of weighted distance that the projection moved the target
    /// [1 / (weight rad/s)], summed over the ticks of a policy step. Returns and metrics stay the environment's own. No
    /// effect where nothing is projected: `ppo`, or `project_in_training = false`.
    pub moved_penalty: f64,
    /// Steps from one evaluation without noise to the next; the best networks are kept as `checkpoints/best.safetensors`. 0: none.
    pub eval_every: u64,
    /// Episodes of an evaluation.
    pub eval_episodes: usize,
    /// Steps from one kept snapshot to the next, `checkpoints/step_<steps>.safetensors`. 0: only the newest is kept.
    pub save_every: u64,
    /// Sizes of the networks.
    pub nets: NetSettings,
    /// Settings of the clipped surrogate, for every algorithm.
    pub ppo: PpoSettings,
    /// Settings of `nearl`.
    pub nearl: NearlSettings,
    /// Settings of `pid2-ib`, `pid2-gan` and `pid2-il`; of them `bc` reads those of the inverse model, and `gaifo` the rate of the discriminator.
    pub pid2: Pid2Settings,
    /// A limit on the cost of an episode.
    pub cost: CostSettings,
    /// Demonstrations, and what is learned from them.
    pub demos: DemoSettings,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            n_envs: 16,
            n_steps: 128,
            gamma: 0.99,
            gae_lambda: 0.95,
            scale_reward: true,
            anneal: true,
            anneal_to: 0.0,
            normalise_obs: true,
            change_scale: ChangeScale::default(),
            exploration: Exploration::default(),
            project_in_training: true,
            limits_in: 0.0,
            moved_penalty: 0.0,
            eval_every: 0,
            eval_episodes: 10,
            save_every: 0,
            nets: NetSettings::default(),
            ppo: PpoSettings::default(),
            nearl: NearlSettings::default(),
            pid2: Pid2Settings::default(),
            cost: CostSettings::default(),
            demos: DemoSettings::default(),
        }
    }
}

impl TrainSettings {
    /// Reads the section.
    ///
    /// # Errors
    /// One sentence naming the key.
    pub fn read(table: &toml::Table) -> Result<Self, String> {
        let settings: Self = serde_path_to_error::deserialize(table.clone())
            .map_err(|e| refusal(&e.path().to_string(), e.inner().message()))?;
        if settings.eval_episodes == 0 {
            return Err("[train.eval_episodes]: 0 measures nothing; give at least 1".into());
        }
        let positive = [("n_envs", settings.n_envs), ("n_steps", settings.n_steps)];
        if let Some((key, _)) = positive.iter().find(|(_, v)| *v == 0) {
            return Err(format!("[train.{key}]: 0 collects nothing; give at least 1"));
        }
        for (key, v) in [
            ("gamma", settings.gamma),
            ("gae_lambda", settings.gae_lambda),
            ("anneal_to", settings.anneal_to),
            ("limits_in", settings.limits_in),
        ] {
            if !(0.0..=1.0).contains(&v) {
                return Err(format!("[train.{key}]: {v} is outside [0, 1]"));
            }
        }
        settings.check_learners()?;
        if !(settings.moved_penalty.is_finite() && settings.moved_penalty >= 0.0) {
            return Err(format!(
                "[train.moved_penalty]: {} would reward being moved; give 0 or a positive number",
                settings.moved_penalty
            ));
        }
        settings.nets.check()?;
        settings.demos.check()?;
        Ok(settings)
    }

    /// Numbers with which no learner learns.
    fn check_learners(&self) -> Result<(), String> {
        let (ppo, pid2, nearl, cost) = (&self.ppo, &self.pid2, &self.nearl, &self.cost);
        if ppo.n_epochs == 0 {
            return Err("[train.ppo.n_epochs]: 0 learns nothing; give at least 1".into());
        }
        let above = |x: f64| x > 0.0 && x.is_finite();
        let at_least = |x: f64| x >= 0.0 && x.is_finite();
        let norm = |x: f64| x > 0.0;
        let limit = |x: f64| x >= 0.0;
        let spread = |x: f64| (-20.0..=10.0).contains(&x);
        type Domain = (fn(f64) -> bool, &'static str);
        let (positive, not_negative): (Domain, Domain) =
            ((above, "finite and above 0"), (at_least, "finite and at least 0"));
        let single = f64::from;
        for (key, value, (allowed, domain)) in [
            ("ppo.lr", single(ppo.lr), positive),
            ("ppo.value_lr", single(ppo.value_lr), not_negative),
            ("ppo.clip_range", single(ppo.clip_range), positive),
            ("ppo.clip_to", single(ppo.clip_to), positive),
            ("ppo.clip_value", single(ppo.clip_value), not_negative),
            ("ppo.target_kl", single(ppo.target_kl), not_negative),
            ("ppo.desired_kl", single(ppo.desired_kl), not_negative),
            ("ppo.vf_coef", single(ppo.vf_coef), not_negative),
            ("ppo.ent_coef", single(ppo.ent_coef), not_negative),
            ("ppo.max_grad_norm", single(ppo.max_grad_norm), (norm, "above 0, or inf for none")),
            ("ppo.log_std", single(ppo.log_std), (spread, "between -20 and 10")),
            ("pid2.idm_threshold", pid2.idm_threshold, not_negative),
            ("pid2.idm_lr", single(pid2.idm_lr), positive),
            ("pid2.discriminator_lr", single(pid2.discriminator_lr), positive),
            ("pid2.generator_weight", single(pid2.generator_weight), not_negative),
            ("pid2.lr", single(pid2.lr), not_negative),
            ("pid2.generator_lr", single(pid2.generator_lr), not_negative),
            ("pid2.gradient_penalty", single(pid2.gradient_penalty), not_negative),
            ("pid2.bound_weight", single(pid2.bound_weight), not_negative),
            ("pid2.i_c", single(pid2.i_c), not_negative),
            ("pid2.beta", single(pid2.beta), not_negative),
            ("pid2.alpha", single(pid2.alpha), not_negative),
            ("nearl.policy_lr", single(nearl.policy_lr), not_negative),
            ("nearl.idm_threshold", nearl.idm_threshold, not_negative),
            ("nearl.idm_lr", single(nearl.idm_lr), positive),
            ("cost.limit", cost.limit, (limit, "at least 0, or inf for none")),
            ("cost.lr", single(cost.lr), not_negative),
            ("cost.gain", single(cost.gain), not_negative),
            ("cost.multiplier", single(cost.multiplier), not_negative),
        ] {
            if !allowed(value) {
                let value = value as f32; // as it was written
                return Err(format!("[train.{key}]: {value} is not {domain}; correct it"));
            }
        }
        Ok(())
    }
}

/// What is wrong at `key`. A key of another section is told with that section, any other with the one it resembles.
fn refusal(key: &str, message: &str) -> String {
    let name = key.rsplit('.').next().unwrap_or(key);
    let sections = toml::Table::try_from(TrainSettings::default()).unwrap_or_else(|e| unreachable!("{e}"));
    let own = sections.contains_key(name).then(|| format!("train.{name}"));
    let of = |(section, keys): (&String, &toml::Value)| {
        keys.as_table().is_some_and(|keys| keys.contains_key(name)).then(|| format!("train.{section}.{name}"))
    };
    let there: Vec<String> = own.into_iter().chain(sections.iter().filter_map(of)).collect();
    if there.is_empty() || !message.starts_with("unknown field") {
        return format!("[train.{key}]: {}", suggest(message));
    }
    format!("[train.{key}]: no such key here; give {}", there.join(" or "))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The value in the row of `key`, after the heading of its table.
    fn on_page(page: &str, table: &str, key: &str) -> toml::Value {
        let (_, rows) = page.split_once(table).unwrap_or_else(|| panic!("no '{table}' on the page"));
        let row = rows.lines().find_map(|l| l.strip_prefix(&format!("| `{key}` | ")));
        let cell = row.unwrap_or_else(|| panic!("no '{key}' below '{table}'")).split(" |").next();
        let text = format!("x = {}", cell.unwrap().trim_matches('`'));
        toml::from_str::<toml::Table>(&text).unwrap_or_else(|e| panic!("{key}: {e}"))["x"].clone()
    }

    #[test]
    fn the_page_about_training_has_every_key_with_its_value_and_every_column() {
        let page = include_str!("../../docs/TRAINING.md");
        let number = |v: &toml::Value| v.as_float().or(v.as_integer().map(|i| i as f64));
        let mut keys = 0;
        let mut compare = |table: &str, key: &str, value: &toml::Value| {
            let told = on_page(page, table, key);
            let same = match (number(&told), number(value)) {
                (Some(a), Some(b)) => a == b || (a - b).abs() <= 1e-6 * b.abs(),
                _ => told == *value,
            };
            assert!(same, "{table} {key}: {told} on the page, {value} in the program");
            keys += 1;
        };
        let settings = toml::Table::try_from(TrainSettings::default()).unwrap();
        for (key, value) in &settings {
            match value {
                toml::Value::Table(section) => {
                    section.iter().for_each(|(k, v)| compare(&format!("| `train.{key}` |"), k, v));
                }
                value => compare("## `[train]`", key, value),
            }
        }
        assert_eq!(keys, 77);
        for column in crate::train::COLUMNS {
            assert!(page.contains(&format!("`{column}`")), "{column}");
        }
    }

    #[test]
    fn numbers_with_which_nothing_learns_are_refused_by_name() {
        let read = |text: &str| TrainSettings::read(&toml::from_str(text).unwrap());
        for (text, words) in [
            ("ppo.clip_range = -0.2", "[train.ppo.clip_range]: -0.2 is"),
            ("ppo.lr = nan", "[train.ppo.lr]: NaN is not finite and above 0"),
            ("ppo.n_epochs = 0", "[train.ppo.n_epochs]: 0 learns nothing"),
            ("ppo.max_grad_norm = -1.0", "[train.ppo.max_grad_norm]"),
            ("ppo.log_std = nan", "[train.ppo.log_std]"),
            (
                "pid2.generator_weight = -5.0",
                "[train.pid2.generator_weight]: -5 is not finite and at least 0",
            ),
            ("pid2.beta = nan", "[train.pid2.beta]"),
            ("nearl.idm_lr = -1.0", "[train.nearl.idm_lr]"),
            ("cost.limit = -1.0", "[train.cost.limit]: -1 is not at least 0, or inf for none"),
            ("cost.lr = nan", "[train.cost.lr]"),
            ("ppo.gae_lambda = 0.9", "[train.ppo.gae_lambda]: no such key here; give train.gae_lambda"),
            ("beta = 0.1", "[train.beta]: no such key here; give train.pid2.beta"),
            ("idm_lr = 0.1", "give train.nearl.idm_lr or train.pid2.idm_lr"),
            ("ppo.batch_siz = 64", "did you mean 'batch_size'?"),
            ("ppo.lr = \"fast\"", "[train.ppo.lr]: it is \"fast\"; give a number"),
        ] {
            let refused = read(text).unwrap_err();
            assert!(refused.contains(words), "{refused}");
        }
        assert!(read("ppo.max_grad_norm = inf").is_ok(), "no clipping");
        assert!(read("pid2 = { generator_weight = 0.0, idm_threshold = 0.0 }").is_ok());
    }
}
