//! The newest message of one sender: how state and action travel. Of both only the newest counts, and a tick waits for them.
//!
//! A file of shared memory holds a count and two places for the message. The sender writes into the place that the count does not
//! show, then counts on; a reader copies the place that is shown and keeps the copy if the count is still the same. Nobody waits for
//! anybody, there is no system call, and a process killed at any moment leaves the last whole message. Only the entries in use are copied.
//!
//! Beside each place stands a checksum of its words and its number. Where something else has written into a message, the checksum does not fit,
//! and the message is refused.
//!
//! The file gets its name when it is complete. A sender's successor puts its own in its place, which readers find when they
//! [`attend`](BoardReader::attend); who may send is decided by [`Owner`](super::owner::Owner).
//!
//! iceoryx2 0.10 has no service for this: its queue takes more than twice as long (`examples/round_trip.rs`), and its blackboard never gives
//! the place of a killed writer to the next one.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::ptr;
use std::sync::atomic::{AtomicU64, Ordering, fence};

use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};

use super::schema::{Arrays, WORD};
use super::{Header, LinkError, Message, RobotName, home, memory};
use crate::clock;

/// Words between what must not share a cache line, nor the line fetched with it.
const APART: usize = 128 / WORD;
/// Where the schema hash of the message lies [words].
const SCHEMA: usize = 0;
/// Where the count lies: the number of the newest message, 0 before the first [words].
const COUNT: usize = APART;
/// Where the first place begins [words].
const PLACES: usize = 2 * APART;

/// By which the first word counts in the sum of a message; odd, as those of the words after it are, which are two apart.
const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;

/// Words of a message.
const fn words<M>() -> usize {
    assert!(size_of::<M>().is_multiple_of(WORD) && align_of::<M>() == WORD, "a message is a row of words");
    size_of::<M>() / WORD
}

/// The file of a message, mapped.
struct Memory {
    start: *mut std::ffi::c_void,
    words: usize,
}

// SAFETY: the mapping belongs to this value alone, and its words are atomic.
unsafe impl Send for Memory {}

impl Memory {
    /// Words of a place: a message and its sum.
    const fn place_length<M>() -> usize {
        (words::<M>() + 1).next_multiple_of(APART)
    }

    /// Words of the file of a message: schema, count, two places.
    const fn length<M>() -> usize {
        PLACES + 2 * Self::place_length::<M>()
    }

    fn map<M>(file: &File, rights: ProtFlags) -> io::Result<Memory> {
        let words = Self::length::<M>();
        if file.metadata()?.len() < (words * WORD) as u64 {
            return Err(io::Error::other("it is shorter than its message"));
        }
        // SAFETY: a new mapping at an address of the system's choice; nothing else refers to it.
        let start = unsafe { mmap(ptr::null_mut(), words * WORD, rights, MapFlags::SHARED, file, 0) }?;
        Ok(Memory { start, words })
    }

    fn all(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has this length, begins at a page and lives as long as `self`; other processes write whole words.
        unsafe { std::slice::from_raw_parts(self.start.cast(), self.words) }
    }

    fn count(&self) -> &AtomicU64 {
        &self.all()[COUNT]
    }

    /// The place of the message with this number, and that of its sum.
    fn place<M>(&self, number: u64) -> (&[AtomicU64], &AtomicU64) {
        let start = PLACES + (number % 2) as usize * Self::place_length::<M>();
        (&self.all()[start..start + words::<M>()], &self.all()[start + words::<M>()])
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // SAFETY: the mapping made in `map`, which nothing refers to any more.
        let _ = unsafe { munmap(self.start, self.words * WORD) };
    }
}

/// Where the file of a topic lies.
fn path<M: Message>(name: &RobotName) -> PathBuf {
    name.folder().join(format!("newest-{}", M::TOPIC))
}

/// Sending end, for the owner of the topic's role. Dropping it takes the file's name away.
pub(crate) struct Board<M: Message + Arrays> {
    path: PathBuf,
    memory: Memory,
    epoch: u64,
    number: u64,
    _message: std::marker::PhantomData<M>,
}

impl<M: Message + Arrays> Board<M> {
    /// Makes the file, in place of one that is there. The owner of the role only.
    pub(crate) fn create(name: &RobotName, epoch: u64) -> Result<Board<M>, LinkError> {
        let path = path::<M>(name);
        let failed = |e: io::Error| name.transport(format!("make {}", path.display()), e.to_string());
        // The owner's alone: what a predecessor left half made is begun anew.
        let half = PathBuf::from(format!("{}.half", path.display()));
        let _ = std::fs::remove_file(&half);
        let file = home::private().read(true).write(true).create_new(true).open(&half);
        let file = file.map_err(|e| home::foreign(name, &half, &e))?;
        let bytes = (Memory::length::<M>() * WORD) as u64;
        fallocate(&file, FallocateFlags::empty(), 0, bytes).map_err(|e| match e {
            Errno::NOSPC => memory::too_small(name, memory::free(), bytes),
            other => failed(other.into()),
        })?;
        let memory = Memory::map::<M>(&file, ProtFlags::READ | ProtFlags::WRITE).map_err(failed)?;
        memory.all()[SCHEMA].store(M::SCHEMA, Ordering::Relaxed);
        std::fs::rename(&half, &path).map_err(failed)?;
        Ok(Board { path, memory, epoch, number: 0, _message: std::marker::PhantomData })
    }

    /// Numbers, stamps and shows `message`.
    pub(crate) fn send(&mut self, message: &mut M) {
        self.number += 1;
        *message.header_mut() =
            Header { schema: M::SCHEMA, epoch: self.epoch, seq: self.number, stamp: clock::now() };
        let (place, sum) = self.memory.place::<M>(self.number);
        // Whoever reads a word written from here on sees that the message before has been shown.
        fence(Ordering::Release);
        let words = words_of(message);
        for range in std::iter::once(0..M::FIXED).chain(message.arrays()) {
            for (to, from) in place[range.clone()].iter().zip(&words[range]) {
                to.store(*from, Ordering::Relaxed);
            }
        }
        sum.store(sum_of(self.number, message), Ordering::Relaxed);
        self.memory.count().store(self.number, Ordering::Release);
    }
}

impl<M: Message + Arrays> Drop for Board<M> {
    fn drop(&mut self) {
        // Readers keep what they have mapped. The name is this sender's as long as it owns the role.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Receiving end.
pub(crate) struct BoardReader<M: Message + Arrays> {
    path: PathBuf,
    /// The sender's file, and its number in the file system.
    memory: Option<Memory>,
    file: u64,
    number: u64,
    message: Box<M>,
    /// What is being read, and takes the place of the last message if it is whole.
    read: Box<M>,
    /// Messages of another layout or without their sum, and files that are none of ours.
    pub(crate) refused: u64,
}

impl<M: Message + Arrays> BoardReader<M> {
    /// Finds the sender if it is there; else [`BoardReader::attend`] will.
    pub(crate) fn open(name: &RobotName) -> BoardReader<M> {
        let (path, message, read) = (path::<M>(name), Box::new(M::zeroed()), Box::new(M::zeroed()));
        let mut reader = BoardReader { path, memory: None, file: 0, number: 0, message, read, refused: 0 };
        reader.attend();
        reader
    }

    /// Turns to a sender that came since the last call. One system call if none did.
    pub(crate) fn attend(&mut self) {
        let Ok(named) = std::fs::symlink_metadata(&self.path) else { return };
        if named.ino() != self.file {
            // A file that vanishes meanwhile is looked for again with the next call.
            let file = match home::own_file(&self.path, false) {
                Ok(file) => file,
                Err(e) if e.kind() == io::ErrorKind::NotFound => return,
                Err(_) => {
                    (self.file, self.refused) = (named.ino(), self.refused + 1);
                    return;
                }
            };
            let Ok(meta) = file.metadata() else { return };
            self.file = meta.ino();
            match Memory::map::<M>(&file, ProtFlags::READ) {
                Ok(memory) if memory.all()[SCHEMA].load(Ordering::Relaxed) == M::SCHEMA => {
                    (self.memory, self.number) = (Some(memory), 0);
                }
                _ => self.refused += 1,
            }
        }
    }

    /// The newest message, if it was not read before.
    #[inline]
    pub(crate) fn newest(&mut self) -> Option<&M> {
        let memory = self.memory.as_ref()?;
        let mut number = memory.count().load(Ordering::Acquire);
        if number == self.number {
            return None;
        }
        let sum = loop {
            let (place, sum) = memory.place::<M>(number);
            copy(place, &mut *self.read);
            let sum = sum.load(Ordering::Relaxed);
            // Whatever of this was written after the next message was shown, that message is seen to be shown.
            fence(Ordering::Acquire);
            let now = memory.count().load(Ordering::Relaxed);
            if now == number {
                break sum;
            }
            number = now;
        };
        self.number = number;
        if self.read.header().schema != M::SCHEMA || sum != sum_of(number, &*self.read) {
            self.refused += 1;
            return None;
        }
        std::mem::swap(&mut self.message, &mut self.read);
        Some(&self.message)
    }
}

impl<M: Message + Arrays> BoardReader<M> {
    /// The message read last; all numbers zero before the first.
    pub(crate) fn last(&self) -> &M {
        &self.message
    }
}

/// Copies the entries in use; the others stay zero.
#[inline]
fn copy<M: Message + Arrays>(place: &[AtomicU64], message: &mut M) {
    let take = |message: &mut M, range: Range<usize>| {
        let words = words_of_mut(message);
        for (to, from) in words[range.clone()].iter_mut().zip(&place[range]) {
            *to = from.load(Ordering::Relaxed);
        }
    };
    let before = message.arrays();
    take(message, 0..M::FIXED);
    if message.arrays() != before {
        words_of_mut(message)[M::FIXED..].fill(0);
    }
    for range in message.arrays() {
        take(message, range);
    }
}

/// The sum of a message's number and of the words in use, each times an odd number of its own: no word changes alone without changing it, and
/// what is changed at random keeps it once in 2^64.
fn sum_of<M: Message + Arrays>(number: u64, message: &M) -> u64 {
    let words = words_of(message);
    let used = std::iter::once(0..M::FIXED).chain(message.arrays()).flatten();
    let weighed = used.map(|at| words[at].wrapping_mul(FACTOR.wrapping_add(2 * at as u64)));
    weighed.fold(number.wrapping_mul(FACTOR), u64::wrapping_add)
}

fn words_of<M: Message>(message: &M) -> &[u64] {
    // SAFETY: a message is plain numbers without padding, in whole aligned words.
    unsafe { std::slice::from_raw_parts(ptr::from_ref(message).cast(), words::<M>()) }
}

fn words_of_mut<M: Message>(message: &mut M) -> &mut [u64] {
    // SAFETY: as above, and every bit pattern is a value.
    unsafe { std::slice::from_raw_parts_mut(ptr::from_mut(message).cast(), words::<M>()) }
}

#[cfg(test)]
mod tests {
    use super::super::{ActionMessage, MAX_OBS, StateMessage, remove_files};
    use super::*;
    use std::sync::atomic::AtomicBool;

    fn name(what: &str) -> RobotName {
        RobotName::new(&format!("t{}-{what}", std::process::id())).unwrap()
    }

    fn state(nq: u32, n_obs: u32, value: f64) -> StateMessage {
        let mut state = StateMessage::zeroed();
        (state.nq, state.nv, state.n_obs) = (nq, nq, n_obs);
        state.q_mut().fill(value);
        state.v_mut().fill(-value);
        state.obs_mut().fill(value);
        state
    }

    #[test]
    fn the_newest_is_read_once_and_successors_are_found() {
        let name = name("board");
        let _home = home::Home::enter(&name).unwrap();
        let mut reader = BoardReader::<StateMessage>::open(&name);
        assert!(reader.newest().is_none());
        let mut first = Board::create(&name, 1).unwrap();
        reader.attend();
        assert!(reader.newest().is_none(), "nothing was sent yet");
        for value in [1.0, 2.0, 3.0] {
            first.send(&mut state(7, 14, value));
        }
        let newest = reader.newest().unwrap();
        assert_eq!((newest.header.epoch, newest.header.seq, newest.obs()), (1, 3, [3.0; 14].as_slice()));
        assert!(reader.newest().is_none());
        // Another sender: what the first one shows is read until its successor is attended to.
        first.send(&mut state(7, 14, 4.0));
        std::mem::forget(first); // as a killed process leaves it
        let mut second = Board::create(&name, 2).unwrap();
        second.send(&mut state(2, 1, 5.0));
        assert_eq!(reader.newest().map(|s| s.header.epoch), Some(1));
        reader.attend();
        let newest = reader.newest().unwrap();
        assert_eq!((newest.header.epoch, newest.header.seq, newest.q()), (2, 1, [5.0, 5.0].as_slice()));
        assert!(
            newest.q[2..].iter().chain(&newest.obs[1..]).all(|x| *x == 0.0),
            "what is not in use is zero"
        );
        drop(second);
        assert!(!path::<StateMessage>(&name).exists(), "the name goes with its owner");
        remove_files(&name);
    }

    #[test]
    fn a_message_is_never_torn() {
        let name = name("torn");
        let _home = home::Home::enter(&name).unwrap();
        let mut board = Board::create(&name, 1).unwrap();
        let mut reader = BoardReader::<ActionMessage>::open(&name);
        let over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut action = ActionMessage::zeroed();
                for tick in 1..=1_000_000_u64 {
                    (action.tick, action.nu) = (tick, 1 + (tick % 64) as u32);
                    action.action_mut().fill(tick as f64);
                    board.send(&mut action);
                }
                over.store(true, Ordering::Release);
            });
            let mut last = 0;
            while !over.load(Ordering::Acquire) {
                let Some(action) = reader.newest() else { continue };
                assert!(action.header.seq > last && action.tick == action.header.seq);
                assert_eq!(u64::from(action.nu), 1 + action.tick % 64);
                assert!(action.action().iter().all(|x| *x == action.tick as f64), "{action:?}");
                last = action.tick;
            }
        });
        remove_files(&name);
    }

    #[test]
    fn a_message_that_was_written_into_is_refused_whichever_word_it_was() {
        let name = name("scribbled");
        let _home = home::Home::enter(&name).unwrap();
        let mut board = Board::create(&name, 1).unwrap();
        let mut reader = BoardReader::<ActionMessage>::open(&name);
        let mut action = ActionMessage::zeroed();
        action.nu = 7;
        action.action_mut().fill(0.25);
        let used: Vec<usize> =
            (0..ActionMessage::FIXED).chain(action.arrays().into_iter().flatten()).collect();
        for (k, word) in used.iter().enumerate() {
            for written in [f64::INFINITY.to_bits(), 1e200_f64.to_bits(), u64::MAX, 0] {
                board.send(&mut action);
                let place = &board.memory.place::<ActionMessage>(board.number).0[*word];
                let was = place.swap(written, Ordering::Relaxed);
                let refused = reader.refused;
                assert_eq!(reader.newest().is_none(), was != written, "word {word}");
                assert_eq!(reader.refused, refused + u64::from(was != written));
                assert!(
                    k == 0 || reader.last().action().iter().all(|x| *x == 0.25),
                    "the last whole one is kept"
                );
            }
            board.send(&mut action);
            assert!(reader.newest().is_some(), "the next is whole");
        }
        remove_files(&name);
    }

    #[test]
    fn foreign_files_and_lying_lengths_are_refused_or_clamped() {
        let name = name("foreign");
        let _home = home::Home::enter(&name).unwrap();
        std::os::unix::fs::symlink("/etc/passwd", path::<StateMessage>(&name)).unwrap();
        let mut linked = BoardReader::<StateMessage>::open(&name);
        linked.attend();
        assert_eq!(linked.refused, 1, "a link is refused once, and not followed");
        std::fs::remove_file(path::<StateMessage>(&name)).unwrap();
        home::own_file(&path::<StateMessage>(&name), true).unwrap();
        std::fs::write(path::<StateMessage>(&name), b"short").unwrap();
        let mut reader = BoardReader::<StateMessage>::open(&name);
        assert!(reader.newest().is_none());
        assert_eq!(reader.refused, 1);
        reader.attend();
        assert_eq!(reader.refused, 1, "a file is refused once");

        let board = Board::<StateMessage>::create(&name, 1).unwrap();
        reader.attend();
        let mut lie = StateMessage::zeroed();
        words_of_mut(&mut lie).fill(u64::MAX);
        let show = |number: u64, message: &StateMessage, sum: u64| {
            let (place, of_place) = board.memory.place::<StateMessage>(number);
            place.iter().zip(words_of(message)).for_each(|(to, from)| to.store(*from, Ordering::Relaxed));
            of_place.store(sum, Ordering::Relaxed);
            board.memory.count().store(number, Ordering::Release);
        };
        show(9, &lie, sum_of(9, &lie));
        assert!(reader.newest().is_none(), "another schema");
        assert_eq!(reader.refused, 2);
        lie.header.schema = StateMessage::SCHEMA;
        show(10, &lie, sum_of(10, &lie));
        assert_eq!(reader.newest().unwrap().obs().len(), MAX_OBS);
        // Not its sum, and the sum of the same message with another number.
        show(11, &lie, sum_of(11, &lie) ^ 1);
        assert!(reader.newest().is_none());
        show(12, &lie, sum_of(14, &lie));
        assert!(reader.newest().is_none());
        assert_eq!(reader.refused, 4);

        board.memory.all()[SCHEMA].store(7, Ordering::Relaxed);
        let mut late = BoardReader::<StateMessage>::open(&name);
        assert!(late.newest().is_none());
        assert_eq!(late.refused, 1);
        remove_files(&name);
    }
}
