//! One training on several hosts, or in several processes of one: its ranks.
//!
//! Every rank holds the whole learner and simulates its part of the environments. After collecting, each hands what its environments
//! gave to all others, so that all have the same batch and draw the same minibatches. Of a minibatch each rank computes some shards;
//! the gradients of all shards are handed round and added in the order of the shards. So any number of ranks gives the same weights,
//! bit for bit. How bytes get from rank to rank is a [`Gather`]'s business; in Python it is `torch.distributed`.
//!
//! Each rank has all it needs to go on alone. When another one is lost, a rank computes what is missing by itself, ends the update with the
//! bits it would have had, and then stops with [`RankError::Lost`] and a checkpoint.

use std::fmt;
use std::ops::Range;
use std::sync::{Mutex, OnceLock, PoisonError};

/// How ranks hand bytes to each other.
pub trait Gather: Send + Sync {
    /// Hands `mine` to every rank and returns what all ranks handed in, one after the other in their order. All ranks call it equally
    /// often and with the same number of bytes.
    ///
    /// # Errors
    /// What went wrong, when a rank cannot be reached.
    fn gather(&self, mine: &[u8]) -> Result<Vec<u8>, String>;
}

/// Why ranks cannot train together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RankError {
    /// A rank that there cannot be.
    #[error(
        "rank {rank} of {size}: ranks count from 0 to one less than their number; correct RANK and WORLD_SIZE"
    )]
    Place {
        /// Rank.
        rank: usize,
        /// Ranks.
        size: usize,
    },
    /// Fewer environments than ranks.
    #[error(
        "[train.n_envs]: {n_envs} environments for {size} ranks, and each needs one; give more, or start fewer ranks"
    )]
    Environments {
        /// Environments.
        n_envs: usize,
        /// Ranks.
        size: usize,
    },
    /// A rank is not there any more.
    #[error(
        "rank {rank} of {size} was left alone after {steps} steps, another rank is gone: {reason}; start all ranks again from the run folder of \
         rank 0 to go on from its checkpoint"
    )]
    Lost {
        /// This rank.
        rank: usize,
        /// Ranks.
        size: usize,
        /// Steps that were learned from.
        steps: u64,
        /// What the [`Gather`] said.
        reason: String,
    },
    /// Ranks that do not do the same.
    #[error(
        "ranks {rank} and {other} do not train the same: {what}; start every rank with the same arguments and the same build"
    )]
    Different {
        /// This rank.
        rank: usize,
        /// The other one.
        other: usize,
        /// What differs, here and there.
        what: String,
    },
}

/// The ranks of a training, seen from one of them.
pub struct Ranks {
    rank: usize,
    size: usize,
    gather: Box<dyn Gather>,
    /// What the gather said when another rank was lost. No word is said to the others afterwards.
    lost: OnceLock<String>,
    /// Shards are handed round by one thread; nobody else speaks meanwhile.
    speaks: Mutex<()>,
}

impl fmt::Debug for Ranks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "rank {} of {}", self.rank, self.size)
    }
}

impl Ranks {
    /// Rank `rank` of `size`.
    ///
    /// # Errors
    /// [`RankError::Place`].
    pub fn new(rank: usize, size: usize, gather: Box<dyn Gather>) -> Result<Self, RankError> {
        if rank >= size {
            return Err(RankError::Place { rank, size });
        }
        Ok(Self { rank, size, gather, lost: OnceLock::new(), speaks: Mutex::new(()) })
    }

    /// This rank.
    pub fn rank(&self) -> usize {
        self.rank
    }

    /// Number of ranks.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Why this rank is alone now, if it is.
    pub fn lost(&self) -> Option<&str> {
        self.lost.get().map(String::as_str)
    }

    /// The error to stop with after `steps` steps, if this rank is alone.
    pub(crate) fn check(&self, steps: u64) -> Result<(), RankError> {
        let Some(reason) = self.lost() else { return Ok(()) };
        Err(RankError::Lost { rank: self.rank, size: self.size, steps, reason: reason.to_string() })
    }

    /// The environments of a rank, of `n_envs`.
    pub(crate) fn part(&self, rank: usize, n_envs: usize) -> Range<usize> {
        n_envs * rank / self.size..n_envs * (rank + 1) / self.size
    }

    /// What all ranks hand in, each the same number of bytes; nothing when one is lost.
    pub(crate) fn even(&self, mine: &[u8]) -> Option<Vec<u8>> {
        let _speaks = self.speaks.lock().unwrap_or_else(PoisonError::into_inner);
        if self.lost().is_some() {
            return None;
        }
        let all = self.gather.gather(mine).and_then(|all| match all.len() == self.size * mine.len() {
            true => Ok(all),
            false => Err(format!(
                "{} bytes came back where {} ranks gave {} each",
                all.len(),
                self.size,
                mine.len()
            )),
        });
        match all {
            Ok(all) => Some(all),
            Err(reason) => {
                let _ = self.lost.set(reason);
                None
            }
        }
    }

    /// What all ranks hand in, of any length.
    pub(crate) fn uneven(&self, mine: &[u8]) -> Option<Vec<Vec<u8>>> {
        let lengths = self.even(&(mine.len() as u64).to_le_bytes())?;
        let lengths: Vec<usize> =
            lengths.as_chunks::<8>().0.iter().map(|n| u64::from_le_bytes(*n) as usize).collect();
        let longest = lengths.iter().copied().max().unwrap_or(0).max(1);
        let mut padded = mine.to_vec();
        padded.resize(longest, 0);
        let all = self.even(&padded)?;
        Some(all.chunks_exact(longest).zip(lengths).map(|(part, n)| part[..n].to_vec()).collect())
    }
}

/// What rank 0 hands in, on every rank.
///
/// # Errors
/// [`RankError::Lost`].
pub fn from_first(ranks: &Ranks, mine: Vec<u8>) -> Result<Vec<u8>, RankError> {
    let all = ranks.uneven(if ranks.rank == 0 { &mine } else { &[] });
    ranks.check(0)?;
    Ok(all.and_then(|all| all.into_iter().next()).unwrap_or_default())
}
