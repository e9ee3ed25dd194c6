//! Handing a new controller to the real-time thread and getting the old one back.
//!
//! Two rings of one place, of boxes only: the real-time thread moves a pointer in and a pointer out. It takes a new
//! controller only when there is room to give the old one back, so it never has to drop one.

use rtrb::{Consumer, Producer, RingBuffer};

/// The side that builds and drops. Not the real-time thread.
pub struct Sender<T: Send> {
    new: Producer<Box<T>>,
    old: Consumer<Box<T>>,
}

/// The real-time thread's side.
pub struct Slot<T: Send> {
    new: Consumer<Box<T>>,
    old: Producer<Box<T>>,
}

/// A connected pair.
pub fn slot<T: Send>() -> (Sender<T>, Slot<T>) {
    let (new_in, new_out) = RingBuffer::new(1);
    let (old_in, old_out) = RingBuffer::new(1);
    (Sender { new: new_in, old: old_out }, Slot { new: new_out, old: old_in })
}

impl<T: Send> Sender<T> {
    /// Offers a controller; gives it back while the one before has not been taken.
    pub fn offer(&mut self, value: Box<T>) -> Result<(), Box<T>> {
        self.new.push(value).map_err(|rtrb::PushError::Full(value)| value)
    }

    /// The controller that was replaced; dropped here, by the caller.
    pub fn collect(&mut self) -> Option<Box<T>> {
        self.old.pop().ok()
    }
}

impl<T: Send> Slot<T> {
    /// Puts a waiting controller into `current`; true if there was one. Moves pointers only.
    pub fn swap(&mut self, current: &mut Box<T>) -> bool {
        if self.old.is_full() {
            return false;
        }
        let Ok(new) = self.new.pop() else { return false };
        let old = std::mem::replace(current, new);
        // There is room: only this side pushes, and it was checked above.
        if let Err(rtrb::PushError::Full(old)) = self.old.push(old) {
            std::mem::forget(old);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::ThreadId;

    struct Traced(u32, std::sync::mpsc::Sender<(u32, ThreadId)>);
    impl Drop for Traced {
        fn drop(&mut self) {
            let _ = self.1.send((self.0, std::thread::current().id()));
        }
    }

    #[test]
    fn nothing_is_dropped_by_the_taking_thread() {
        let (drops, dropped) = std::sync::mpsc::channel();
        let (mut sender, mut slot) = slot();
        let make = |n| Box::new(Traced(n, drops.clone()));
        let mut current = make(0);
        assert!(!slot.swap(&mut current));
        sender.offer(make(1)).ok().unwrap();
        assert_eq!(sender.offer(make(2)).unwrap_err().0, 2); // dropped here: it was never taken
        let builder = std::thread::current().id();
        assert_eq!(dropped.try_recv(), Ok((2, builder)));
        let taker = std::thread::spawn(move || {
            assert!(slot.swap(&mut current));
            assert_eq!(current.0, 1);
            (slot, current)
        });
        let (mut slot, mut current) = taker.join().unwrap();
        assert!(dropped.try_recv().is_err());
        sender.offer(make(3)).ok().unwrap();
        assert!(!slot.swap(&mut current), "the old one has not been collected");
        assert_eq!(sender.collect().unwrap().0, 0);
        assert_eq!(dropped.try_recv(), Ok((0, builder)));
        assert!(slot.swap(&mut current));
        assert_eq!(current.0, 3);
    }
}
