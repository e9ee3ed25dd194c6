//! The algorithms by name. The command line, Python, the page about training and the tests read this one table.

use std::fmt;
use std::str::FromStr;

/// What is learned, and by which losses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Algorithm {
    /// See [`ppo`](super::ppo).
    Ppo,
    /// The same loss on the combined policy.
    PpoCombined,
    /// See [`nearl`](super::nearl).
    Nearl,
    /// See [`pid2`](super::pid2), without the bottleneck.
    Pid2Gan,
    /// See [`pid2`](super::pid2).
    Pid2Ib,
    /// See [`bc`](super::bc).
    Bc,
    /// See [`soil`](super::soil).
    Soil,
    /// See [`dapg`](super::dapg).
    Dapg,
    /// See [`pid2_il`](super::pid2_il).
    Pid2Il,
    /// See [`bco`](super::bco).
    Bco,
    /// See [`gaifo`](super::gaifo).
    Gaifo,
}

/// One line of the table.
#[derive(Clone, Copy, Debug)]
pub struct RegisteredAlgorithm {
    /// Which.
    pub algorithm: Algorithm,
    /// As it is written.
    pub name: &'static str,
    /// What it is, in one line.
    pub about: &'static str,
    /// The policy is one on actions: it proposes nothing.
    pub is_direct: bool,
    /// What it has demonstrations for; `None` takes none.
    pub demos: Option<Demonstrated>,
}

/// What an algorithm has demonstrations for.
#[derive(Clone, Copy, Debug)]
pub struct Demonstrated {
    /// They have to hold actions.
    pub needs_actions: bool,
    /// The inverse model learns alone, from noise, before anything else.
    pub warms_up: bool,
    /// Episodes begin in demonstrated states now and then; those that it is compared with were published without.
    pub begins_there: bool,
    /// How much a transition looks demonstrated may be the reward.
    pub likeness: bool,
    /// How near the demonstration is followed may be the reward.
    pub tracking: bool,
}

/// Every algorithm, in the order of the paper; behind them what it is compared with.
pub const ALGORITHMS: &[RegisteredAlgorithm] = &[
    RegisteredAlgorithm {
        algorithm: Algorithm::Ppo,
        name: "ppo",
        about: "a Gaussian policy on actions, nothing proposed or projected; an inverse model learns on the side",
        is_direct: true,
        demos: None,
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::PpoCombined,
        name: "ppo-combined",
        about: "PPO on the paper's two networks, policy and inverse model, without any other loss (its RL-Pure)",
        is_direct: false,
        demos: None,
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Nearl,
        name: "nearl",
        about: "supervised meta policy and inverse model, policy gradient on the pair (the paper's Algorithm 1)",
        is_direct: false,
        demos: None,
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Pid2Gan,
        name: "pid2-gan",
        about: "policy, inverse dynamics and a discriminator without a bottleneck",
        is_direct: false,
        demos: None,
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Pid2Ib,
        name: "pid2-ib",
        about: "policy, inverse dynamics and a discriminator with the information bottleneck (the paper's Algorithm 2)",
        is_direct: false,
        demos: None,
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Bc,
        name: "bc",
        about: "the meta policy clones demonstrated states, the inverse model learns from own experience; no reward is read",
        is_direct: false,
        demos: Some(Demonstrated {
            needs_actions: false,
            warms_up: true,
            begins_there: true,
            likeness: false,
            tracking: false,
        }),
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Soil,
        name: "soil",
        about: "PPO on actions with demonstrations whose actions an inverse model infers",
        is_direct: true,
        demos: Some(Demonstrated {
            needs_actions: false,
            warms_up: true,
            begins_there: true,
            likeness: false,
            tracking: true,
        }),
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Dapg,
        name: "dapg",
        about: "PPO on actions, cloned first, with demonstrated actions in its gradient",
        is_direct: true,
        demos: Some(Demonstrated {
            needs_actions: true,
            warms_up: false,
            begins_there: false,
            likeness: false,
            tracking: true,
        }),
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Pid2Il,
        name: "pid2-il",
        about: "`pid2-ib`, cloned first, whose discriminator takes demonstrated states for real too (Algorithm 2 whole)",
        is_direct: false,
        demos: Some(Demonstrated {
            needs_actions: false,
            warms_up: true,
            begins_there: true,
            likeness: true,
            tracking: true,
        }),
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Bco,
        name: "bco",
        about: "a policy on actions clones demonstrated states, whose actions an inverse model infers; no reward is read",
        is_direct: true,
        demos: Some(Demonstrated {
            needs_actions: false,
            warms_up: true,
            begins_there: false,
            likeness: false,
            tracking: false,
        }),
    },
    RegisteredAlgorithm {
        algorithm: Algorithm::Gaifo,
        name: "gaifo",
        about: "PPO on actions whose reward is how much a transition looks demonstrated; the task's reward is not read",
        is_direct: true,
        demos: Some(Demonstrated {
            needs_actions: false,
            warms_up: false,
            begins_there: false,
            likeness: true,
            tracking: false,
        }),
    },
];

/// A name that no algorithm has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no algorithm '{name}'{near}; give one of {all}")]
pub struct UnknownAlgorithm {
    /// As given.
    pub name: String,
    /// `; did you mean ...`.
    pub near: String,
    /// All names.
    pub all: String,
}

impl Algorithm {
    /// As it is written.
    pub fn name(self) -> &'static str {
        self.registered().name
    }

    /// What it is, in one line.
    pub fn about(self) -> &'static str {
        self.registered().about
    }

    fn registered(self) -> &'static RegisteredAlgorithm {
        let found = ALGORITHMS.iter().find(|e| e.algorithm == self);
        found.unwrap_or_else(|| unreachable!("{self:?} has no line in the table"))
    }

    /// All names, with commas between them.
    pub fn names() -> String {
        ALGORITHMS.iter().map(|e| e.name).collect::<Vec<_>>().join(", ")
    }

    /// Whether the policy is one on actions: it proposes nothing.
    pub fn is_direct(self) -> bool {
        self.registered().is_direct
    }

    /// Whether demonstrations have a weight in its policy gradient (`train.demos.weight`).
    pub fn weighs_demonstrations(self) -> bool {
        matches!(self, Algorithm::Soil | Algorithm::Dapg)
    }

    /// Whether it reads something of `[train.pid2]`.
    pub fn reads_pid2(self) -> bool {
        matches!(
            self,
            Algorithm::Pid2Gan | Algorithm::Pid2Ib | Algorithm::Pid2Il | Algorithm::Bc | Algorithm::Gaifo
        )
    }

    /// What it has demonstrations for; `None` takes none.
    pub fn demos(self) -> Option<Demonstrated> {
        self.registered().demos
    }

    /// Names of those that have such a use for demonstrations.
    pub fn taking(use_of_it: impl Fn(&Demonstrated) -> bool) -> Vec<&'static str> {
        ALGORITHMS.iter().filter(|e| e.demos.as_ref().is_some_and(&use_of_it)).map(|e| e.name).collect()
    }

    /// Names of those that learn from demonstrations.
    pub fn imitating() -> String {
        let names = ALGORITHMS.iter().filter(|e| e.demos.is_some()).map(|e| e.name);
        names.collect::<Vec<_>>().join(", ")
    }
}

impl fmt::Display for Algorithm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Algorithm {
    type Err = UnknownAlgorithm;

    fn from_str(name: &str) -> Result<Self, UnknownAlgorithm> {
        if let Some(e) = ALGORITHMS.iter().find(|e| e.name == name) {
            return Ok(e.algorithm);
        }
        let alike = |e: &RegisteredAlgorithm| (strsim::jaro(e.name, &name.to_lowercase()), e.name);
        let near =
            ALGORITHMS.iter().map(alike).max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(score, _)| *score > 0.7);
        Err(UnknownAlgorithm {
            name: name.into(),
            near: near.map_or(String::new(), |(_, near)| format!("; did you mean '{near}'?")),
            all: Self::names(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_reads_back_and_stands_on_the_page_about_training() {
        let page = include_str!("../../../docs/TRAINING.md");
        for e in ALGORITHMS {
            assert_eq!(e.name.parse(), Ok(e.algorithm));
            assert_eq!(e.algorithm.to_string(), e.name);
            assert!(
                page.contains(&format!("| `{}` | {} |", e.name, e.about)),
                "{} is not on the page",
                e.name
            );
        }
    }

    #[test]
    fn an_unknown_name_is_refused_with_the_nearest_one() {
        let refused = |name: &str| name.parse::<Algorithm>().unwrap_err().to_string();
        assert!(
            refused("pid2").starts_with("no algorithm 'pid2'; did you mean 'pid2-"),
            "{}",
            refused("pid2")
        );
        assert!(refused("PPO").contains("did you mean 'ppo'?"));
        let far = refused("xyz");
        assert!(far.starts_with("no algorithm 'xyz'; give one of ppo, ") && far.ends_with("gaifo"), "{far}");
    }
}
