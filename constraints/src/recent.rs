//! What was given in the last two ticks: limits on a change look back to the last of them that was applied.

/// Numbers of the last tick and of the one before it, where they are known. Nothing is allocated after [`Recent::new`].
#[derive(Clone, Debug)]
pub struct Recent {
    last: Vec<f64>,
    before: Vec<f64>,
    /// How many of the two are known, the last first.
    known: usize,
}

impl Recent {
    /// For `n` numbers a tick, of which none is known.
    pub fn new(n: usize) -> Recent {
        Recent { last: vec![0.0; n], before: vec![0.0; n], known: 0 }
    }

    /// The numbers of the last tick, if they are known.
    pub fn get(&self) -> Option<&[f64]> {
        (self.known > 0).then_some(&self.last)
    }

    /// The same, to go on with where nothing was given.
    pub fn get_mut(&mut self) -> Option<&mut [f64]> {
        (self.known > 0).then_some(&mut self.last)
    }

    /// Adds a tick, of as many `numbers`.
    pub fn push<'a>(&mut self, numbers: impl IntoIterator<Item = &'a f64>) {
        std::mem::swap(&mut self.last, &mut self.before);
        self.last.iter_mut().zip(numbers).for_each(|(own, number)| *own = *number);
        self.known = (self.known + 1).min(2);
    }

    /// Neither is known any more.
    pub fn forget(&mut self) {
        self.known = 0;
    }

    /// What the last tick gave came too late and was never applied: the one before it is the last.
    pub fn recall(&mut self) {
        std::mem::swap(&mut self.last, &mut self.before);
        self.known = self.known.saturating_sub(1);
    }

    /// How many numbers [`Recent::write`] appends.
    pub fn memory_len(&self) -> usize {
        1 + 2 * self.last.len()
    }

    /// Appends what the ticks to come depend on to `memory`: 0 for what is not known.
    pub fn write(&self, memory: &mut Vec<f64>) {
        memory.push(self.known as f64);
        for (tick, numbers) in [&self.last, &self.before].into_iter().enumerate() {
            memory.extend(numbers.iter().map(|&x| if tick < self.known { x } else { 0.0 }));
        }
    }

    /// Takes what [`Recent::write`] appended; returns what is left of `memory`.
    ///
    /// # Panics
    /// When `memory` is shorter.
    pub fn read<'m>(&mut self, memory: &'m [f64]) -> &'m [f64] {
        let (own, rest) = memory.split_at(self.memory_len());
        let (last, before) = own[1..].split_at(self.last.len());
        self.last.copy_from_slice(last);
        self.before.copy_from_slice(before);
        self.known = (own[0] as usize).min(2);
        rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tick_is_taken_back_once() {
        let mut recent = Recent::new(2);
        assert_eq!(recent.get(), None);
        [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]].iter().for_each(|tick| recent.push(tick));
        assert_eq!(recent.get(), Some(&[5.0, 6.0][..]));
        recent.recall();
        assert_eq!(recent.get(), Some(&[3.0, 4.0][..]));
        recent.push(&[7.0, 8.0]);
        recent.recall();
        assert_eq!(recent.get(), Some(&[3.0, 4.0][..]), "what was taken back is not what was before");
        recent.recall();
        assert_eq!(recent.get(), None, "no third tick is kept");
    }

    #[test]
    fn memory_is_all_of_it_and_has_no_left_overs() {
        let mut recent = Recent::new(1);
        recent.push(&[1.0]);
        recent.push(&[2.0]);
        let (mut memory, mut other) = (Vec::new(), Recent::new(1));
        recent.write(&mut memory);
        memory.push(9.0);
        assert_eq!((other.read(&memory), other.get()), (&[9.0][..], Some(&[2.0][..])));
        other.recall();
        assert_eq!(other.get(), Some(&[1.0][..]));
        recent.forget();
        memory.clear();
        recent.write(&mut memory);
        assert_eq!(memory, [0.0; 3]);
    }
}
