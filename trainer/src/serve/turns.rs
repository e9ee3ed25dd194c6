//! Whose turn it is: clients one after the other, and the requests of a client one after the other.

use std::collections::VecDeque;

/// A fair queue: a client with many entries waits no less for its next turn than one with a single entry.
#[derive(Debug)]
pub(super) struct Turns<T> {
    clients: VecDeque<(u128, VecDeque<T>)>,
}

impl<T> Turns<T> {
    pub(super) fn new() -> Turns<T> {
        Turns { clients: VecDeque::new() }
    }

    /// Queues an entry of `client` behind its others.
    pub(super) fn push(&mut self, client: u128, entry: T) {
        match self.clients.iter_mut().find(|(id, _)| *id == client) {
            Some((_, entries)) => entries.push_back(entry),
            None => self.clients.push_back((client, VecDeque::from([entry]))),
        }
    }

    /// The next entry; its client goes to the end.
    pub(super) fn pop(&mut self) -> Option<T> {
        let (client, mut entries) = self.clients.pop_front()?;
        let entry = entries.pop_front();
        if !entries.is_empty() {
            self.clients.push_back((client, entries));
        }
        entry
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_greedy_client_gets_every_second_turn() {
        let mut turns = Turns::new();
        for entry in ["a1", "a2", "a3"] {
            turns.push(1, entry);
        }
        turns.push(2, "b1");
        let mut order = Vec::new();
        for _ in 0..6 {
            let entry = turns.pop().expect("an entry");
            order.push(entry);
            turns.push(if entry.starts_with('a') { 1 } else { 2 }, entry);
        }
        assert_eq!(order, ["a1", "b1", "a2", "b1", "a3", "b1"]);
    }

    #[test]
    fn an_empty_queue_gives_nothing() {
        let mut turns = Turns::new();
        turns.push(1, ());
        assert_eq!((turns.pop(), turns.pop()), (Some(()), None));
    }
}
