//! The viewers' ends of the links: they read topics and send nothing.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::port::Inbox;
use super::runtime::poll_for;
use super::service::Bus;
use super::*;

/// Pause when no tick is there: the topic keeps 32, which is so much at 10 kHz.
const PAUSE: Duration = Duration::from_millis(2);

/// How hard a row was leaned on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LeanedOn {
    /// Ticks in which it was active.
    pub ticks: u64,
    /// Largest multiplier.
    pub multiplier: f64,
    /// Largest slack.
    pub slack: f64,
}

/// What the ticks of a while did.
#[derive(Debug, Default)]
pub struct Watched {
    /// The last of them.
    pub newest: Option<TickMessage>,
    /// How many.
    pub ticks: u64,
    /// Ticks whose raw proposal broke a limit.
    pub raw_violations: u64,
    /// Ticks that began within the limits and whose target broke one.
    pub target_violations: u64,
    /// Time from when each was due until its action was handed over \[ns\].
    pub latency: Vec<u64>,
    /// Rows that were active, by number, kind and side, as the snapshot of the last tick numbers them.
    pub active: BTreeMap<(u32, u32, u32), LeanedOn>,
}

impl Watched {
    /// Adds a tick.
    pub fn take(&mut self, tick: &TickMessage) {
        self.ticks += 1;
        if self.newest.as_ref().is_some_and(|newest| newest.snapshot != tick.snapshot) {
            self.active.clear();
        }
        self.newest = Some(*tick);
        self.latency.push(tick.end.saturating_sub(tick.due));
        if tick.nu == 0 {
            return;
        }
        self.raw_violations += u64::from(tick.ledger.raw_violations > 0);
        self.target_violations += u64::from(tick.ledger.target_breaks());
        let numbers = tick.rows.iter().zip(&tick.kinds).zip(&tick.sides);
        let pulls = tick.multipliers().iter().zip(tick.slacks());
        for (((row, kind), side), (multiplier, slack)) in numbers.zip(pulls) {
            let row = self.active.entry((*row, *kind, *side)).or_default();
            row.ticks += 1;
            row.multiplier = row.multiplier.max(*multiplier);
            row.slack = row.slack.max(*slack);
        }
    }
}

/// Reads what every tick of one robot's loop did.
pub struct ViewLink {
    tick: Inbox<TickMessage>,
    rows: Inbox<RowsMessage>,
    health: Inbox<HealthMessage>,
    robot: Inbox<RobotMessage>,
    bus: Bus,
}

impl ViewLink {
    /// Opens the topics for reading.
    ///
    /// # Errors
    /// [`LinkError`]; [`LinkError::Full`] beside too many other viewers.
    pub fn open(name: &RobotName) -> Result<ViewLink, LinkError> {
        let bus = Bus::join(name)?;
        let link = ViewLink {
            tick: bus.inbox()?,
            rows: bus.inbox()?,
            health: bus.inbox()?,
            robot: bus.inbox()?,
            bus,
        };
        link.bus.reserve()?;
        Ok(link)
    }

    /// Waits for the names of the loop's rows.
    ///
    /// # Errors
    /// [`LinkError::NoRuntime`] after `patience`.
    pub fn wait_for_rows(&mut self, patience: Duration) -> Result<RowsMessage, LinkError> {
        let rows = &mut self.rows;
        poll_for(patience, || rows.newest()).ok_or_else(|| LinkError::NoRuntime(self.bus.name().clone()))
    }

    /// Waits for the plant to say what it is.
    ///
    /// # Errors
    /// [`LinkError::NoPlant`] after `patience`.
    pub fn wait_for_plant(&mut self, patience: Duration) -> Result<RobotMessage, LinkError> {
        let robot = &mut self.robot;
        poll_for(patience, || robot.newest()).ok_or_else(|| LinkError::NoPlant(self.bus.name().clone()))
    }

    /// Adds the ticks of the next `span` to `watched`. Returns the names of the rows, if they were sent meanwhile.
    pub fn watch(&mut self, span: Duration, watched: &mut Watched) -> Option<RowsMessage> {
        let end = Instant::now() + span;
        let mut named = None;
        loop {
            named = self.rows().or(named);
            while let Some(tick) = self.tick() {
                watched.take(&tick);
            }
            if Instant::now() >= end {
                return named;
            }
            std::thread::sleep(PAUSE);
        }
    }

    /// The next tick in order.
    pub fn tick(&mut self) -> Option<TickMessage> {
        self.tick.next()
    }

    /// Ticks lost because they were not read in time.
    pub fn lost(&self) -> u64 {
        self.tick.sequence.lost
    }

    /// The names of the rows, if they were sent since the last call.
    pub fn rows(&mut self) -> Option<RowsMessage> {
        self.rows.newest()
    }

    /// The newest health message not yet read.
    pub fn health(&mut self) -> Option<HealthMessage> {
        self.health.newest()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tick(number: u64, snapshot: u64, multiplier: f64) -> TickMessage {
        let mut tick = TickMessage::zeroed();
        (tick.tick, tick.snapshot, tick.nu, tick.n_active) = (number, snapshot, 1, 1);
        (tick.due, tick.end) = (10, 10 + number);
        (tick.rows[0], tick.kinds[0], tick.sides[0]) = (3, 1, 1);
        tick.multipliers[0] = multiplier;
        (tick.ledger.raw_violations, tick.ledger.target_violations) = (2, 1);
        tick.ledger.outside = number % 2;
        tick
    }

    /// Ticks count once however many limits they break, those that began outside are no violations of the target, and rows are those of one snapshot.
    #[test]
    fn ticks_are_counted_and_rows_kept_by_the_hardest() {
        let mut watched = Watched::default();
        for (number, multiplier) in [(0, 1.0), (1, 4.0), (2, 2.0)] {
            watched.take(&tick(number, 7, multiplier));
        }
        assert_eq!((watched.ticks, watched.raw_violations, watched.target_violations), (3, 3, 2));
        assert_eq!(watched.latency, [0, 1, 2]);
        let leaned = LeanedOn { ticks: 3, multiplier: 4.0, slack: 0.0 };
        assert_eq!(watched.active, BTreeMap::from([((3, 1, 1), leaned)]));
        watched.take(&tick(3, 8, 0.5));
        let leaned = LeanedOn { ticks: 1, multiplier: 0.5, slack: 0.0 };
        assert_eq!(watched.active, BTreeMap::from([((3, 1, 1), leaned)]));
    }
}
