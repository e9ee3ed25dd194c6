//! Snapshots on their way into the loop: from bytes to a built controller to the swap, with one receipt for each. The
//! controller before is kept, and is swapped back in when the robot no longer reaches its targets.
//!
//! Limits that an operator moves take the same way: the snapshot in use is built again with them, and so is every snapshot that comes later.
//! No snapshot overtakes an operator's order. The controller that is kept for going back never has other limits than those in force: after
//! an order, the snapshot before is built again too.

use std::sync::Arc;

use nearl_constraints::Moved;

use crate::clock;
use crate::link::{
    LimitsMessage, Message, ReceiptMessage, RobotMessage, RowsMessage, RuntimeLink, SnapshotBytes,
    SnapshotHeader, Verdict,
};
use crate::log::LogQueue;
use crate::rt::build::{Builder, Built, Source};
use crate::rt::core::Loaded;
use crate::rt::receive::SnapshotReceiver;
use crate::rt::residual::{Residual, RollbackSettings, Weights};
use crate::rt::swap::Sender;
use crate::rt::tick::{Build, LoopController, Record};
use crate::rt::watch::Watched;

/// How many refusals are kept as text for the report.
const KEPT: usize = 32;

/// The I/O thread's side of the hot swap.
pub(crate) struct SnapshotInbox<B: Build> {
    receiver: SnapshotReceiver,
    builder: Builder<B>,
    swap: Sender<Loaded<B::Controller>>,
    /// Built, not yet offered to the loop.
    ready: Option<(SnapshotHeader, Made<B::Controller>)>,
    /// In the slot, not yet taken by the loop.
    offered: Option<Offer>,
    /// What the one in use is made of.
    in_use: Source,
    /// An operator's order that is under way: nothing else is begun until it is answered.
    order: Option<SnapshotHeader>,
    /// The next one, which waits for what was begun before it.
    next_order: Option<(SnapshotHeader, Moved)>,
    /// In use before the current one.
    previous: Option<Made<B::Controller>>,
    /// What weights were in use before the current ones, with whatever limits.
    former: Option<Source>,
    /// Number of the newest that came by an order.
    by_order: u64,
    /// Header of the one in use; none for the first.
    current: Option<SnapshotHeader>,
    residual: Residual,
    /// Why the current one is to be taken back.
    condemned: Option<String>,
    /// Snapshots received; the number of the newest.
    received: u64,
    /// Sender and version of the newest snapshot that came.
    newest: (u64, u64),
    /// When it came, or when the loop began [ns].
    pub(crate) came: u64,
    /// What viewers are told of the one in use.
    pub(crate) rows: Box<RowsMessage>,
    /// Joints of one that was taken into use, for the report.
    pub(crate) watched: Option<Watched>,
    /// Versions taken into use: (first tick at the latest, version of the controller).
    pub(crate) accepted: Vec<(u64, u64)>,
    /// Sentences of refusals, the first ones.
    pub(crate) refusals: Vec<String>,
    refused: u64,
    /// Snapshots taken back.
    pub(crate) rolled_back: u64,
}

/// A controller with what it is made of.
type Made<T> = (Source, Box<Loaded<T>>);

/// What the loop is about to take.
struct Offer {
    /// Header of a new snapshot; none when the previous one is offered again.
    header: Option<SnapshotHeader>,
    source: Source,
    version: u64,
    /// Its number, and what viewers are told of it.
    rows: (u64, Box<RowsMessage>),
    watched: Watched,
}

/// What a look at the snapshots needs of the I/O thread.
pub(crate) struct Surroundings<'a> {
    pub(crate) link: &'a mut RuntimeLink,
    pub(crate) log: &'a mut Option<LogQueue>,
    pub(crate) robot: &'a RobotMessage,
    /// The newest tick known.
    pub(crate) tick: u64,
}

impl<B: Build> SnapshotInbox<B> {
    pub(crate) fn new(
        receiver: SnapshotReceiver,
        builder: Builder<B>,
        swap: Sender<Loaded<B::Controller>>,
        rollback: RollbackSettings,
        first: Vec<u8>,
    ) -> SnapshotInbox<B> {
        SnapshotInbox {
            receiver,
            builder,
            swap,
            ready: None,
            offered: None,
            in_use: Source {
                bytes: Arc::new(first),
                moved: Moved::default(),
                is_order: false,
                goes_back: false,
            },
            order: None,
            next_order: None,
            previous: None,
            former: None,
            by_order: 0,
            current: None,
            residual: Residual::new(rollback),
            condemned: None,
            received: 0,
            newest: (0, 0),
            came: clock::now(),
            rows: Box::new(RowsMessage::zeroed()),
            watched: None,
            accepted: Vec::new(),
            refusals: Vec::new(),
            refused: 0,
            rolled_back: 0,
        }
    }

    /// Snapshots refused so far, those with a header that did not fit included.
    pub(crate) fn refused(&self) -> u64 {
        self.refused + self.receiver.refused()
    }

    /// Snapshot `id` is in use from now on, and viewers are told `rows` of it.
    pub(crate) fn set_rows(&mut self, id: u64, rows: Box<RowsMessage>) {
        self.rows = rows;
        self.rows.snapshot = id;
    }

    /// Takes in a tick and the one before it.
    pub(crate) fn observe(&mut self, previous: &Record, record: &Record) {
        let weights = if record.snapshot == self.by_order { Weights::Same } else { Weights::New };
        if let Some((before, after)) = self.residual.observe(previous, record, weights) {
            self.condemned = Some(format!(
                "taken back: the velocity reached is {after:.3} rad/s or m/s off the target, {before:.3} before the swap"
            ));
        }
    }

    /// Moves every snapshot one stage on.
    pub(crate) fn pump(&mut self, around: &mut Surroundings<'_>) {
        self.settle(around);
        while let Some(order) = around.link.limits() {
            self.hear(around.link, &order);
        }
        self.begin_order(around);
        while self.order.is_none() && self.next_order.is_none() {
            let Some(snapshot) = self.receiver.next() else { break };
            self.receive(around, snapshot);
        }
        if let Some(built) = self.builder.collect() {
            self.take(around, built);
        }
        self.build_former(around);
        self.offer();
    }

    fn receive(&mut self, around: &mut Surroundings<'_>, snapshot: SnapshotBytes) {
        let (sender, version) = (snapshot.header.header.epoch, snapshot.header.version);
        if sender == self.newest.0 && version <= self.newest.1 {
            let text = format!(
                "snapshot version {version} came after version {}: give each push a higher version",
                self.newest.1
            );
            return self.refuse(around.link, &snapshot.header, Verdict::Outdated, &text);
        }
        (self.newest, self.came) = ((sender, version), clock::now());
        self.received += 1;
        let SnapshotBytes { header, bytes } = snapshot;
        let moved = self.in_use.moved.clone();
        let source = Source { bytes: Arc::new(bytes), moved, is_order: false, goes_back: false };
        if let Some(replaced) = self.builder.take(self.received, header, source, *around.robot) {
            supersede(around.link, &replaced);
        }
    }

    /// Takes in what an operator asks for.
    fn hear(&mut self, link: &mut RuntimeLink, order: &LimitsMessage) {
        let mut header = SnapshotHeader { version: order.version, ..SnapshotHeader::default() };
        header.header = order.header;
        match order.moved() {
            Ok(moved) => {
                if let Some((replaced, _)) = self.next_order.replace((header, moved)) {
                    reply(
                        link,
                        &replaced,
                        0,
                        Verdict::Superseded,
                        "newer limits were asked for before these",
                    );
                }
            }
            Err(text) => {
                self.refuse(link, &header, Verdict::Other, &format!("limits that cannot be read: {text}"))
            }
        }
    }

    /// Begins with the next order once nothing else is under way.
    fn begin_order(&mut self, around: &mut Surroundings<'_>) {
        if !self.builder.is_idle() || self.ready.is_some() || self.offered.is_some() || self.order.is_some() {
            return;
        }
        let Some((header, moved)) = self.next_order.take() else { return };
        self.received += 1;
        self.order = Some(header);
        self.by_order = self.received;
        let source =
            Source { bytes: Arc::clone(&self.in_use.bytes), moved, is_order: true, goes_back: false };
        self.builder.take(self.received, header, source, *around.robot); // it was idle: nothing is replaced
    }

    /// What is condemned gives way to the weights before it. Those that have other limits than are in force now are built again.
    fn build_former(&mut self, around: &mut Surroundings<'_>) {
        let is_free =
            self.builder.is_idle() && self.order.is_none() && self.ready.is_none() && self.offered.is_none();
        if self.condemned.is_none() || self.previous.is_some() || !is_free {
            return;
        }
        let Some(former) = self.former.take() else { return };
        self.received += 1;
        let source = Source { moved: self.in_use.moved.clone(), is_order: false, goes_back: true, ..former };
        self.builder.take(self.received, SnapshotHeader::default(), source, *around.robot); // it was idle
    }

    fn take(&mut self, around: &mut Surroundings<'_>, built: Built<B::Controller>) {
        let controller = match built.result {
            Ok(controller) => *controller,
            Err(refusal) if built.source.goes_back => {
                return self.note(&format!("nothing could be taken back to: {}", refusal.text));
            }
            Err(refusal) => {
                if built.source.is_order {
                    self.order = None;
                }
                return self.refuse(around.link, &built.header, refusal.verdict, &refusal.text);
            }
        };
        match around.log {
            Some(log) => {
                log.push_snapshot(built.id, controller.version(), built.bytes, controller.row_names());
            }
            None => self.builder.discard(Box::new(built.bytes)),
        }
        let loaded = Box::new(Loaded { id: built.id, controller });
        let goes_back = built.source.goes_back;
        let made = (built.source, loaded);
        if goes_back {
            self.previous = Some(made);
            return;
        }
        if let Some((header, replaced)) = self.ready.replace((built.header, made)) {
            supersede(around.link, &header);
            self.builder.discard(Box::new(replaced));
        }
    }

    fn offer(&mut self) {
        if self.offered.is_some() {
            return;
        }
        // A new snapshot replaces a condemned one; without a new one, the previous is the better.
        let (header, source, loaded) = match (self.ready.take(), &self.condemned) {
            (Some((header, (source, loaded))), _) => (Some(header), source, loaded),
            (None, Some(_)) => match self.previous.take() {
                Some((source, loaded)) => (None, source, loaded),
                None => return,
            },
            (None, None) => return,
        };
        let (version, rows) = (loaded.controller.version(), (loaded.id, loaded.controller.told()));
        let watched = loaded.controller.watched();
        match (self.swap.offer(loaded), header) {
            (Ok(()), header) => self.offered = Some(Offer { header, source, version, rows, watched }),
            (Err(loaded), Some(header)) => self.ready = Some((header, (source, loaded))),
            (Err(loaded), None) => self.previous = Some((source, loaded)),
        }
    }

    /// The old controller came back: the new one is in use. The one before the old is no longer needed.
    fn settle(&mut self, around: &mut Surroundings<'_>) {
        let Some(old) = self.swap.collect() else { return };
        let Some(Offer { header, source, version, rows, watched }) = self.offered.take() else {
            return self.builder.discard(old);
        };
        self.set_rows(rows.0, rows.1);
        self.watched = Some(watched);
        let condemned = self.condemned.take();
        let is_order = source.is_order;
        if !is_order {
            self.accepted.push((around.tick, version));
        }
        let before =
            std::mem::replace(&mut self.in_use, Source { is_order: false, goes_back: false, ..source });
        let Some(header) = header else {
            self.builder.discard(Box::new((before, old)));
            self.former = None;
            if let (Some(bad), Some(text)) = (self.current.take(), condemned) {
                self.rolled_back += 1;
                self.note(&text);
                reply(around.link, &bad, around.tick, Verdict::RolledBack, &text);
            }
            return;
        };
        if is_order {
            // Nothing with other limits is kept; what is run has the weights that it had, and may still have to go.
            (self.order, self.condemned) = (None, condemned);
            let previous = self.previous.take();
            previous.into_iter().for_each(|scrap| self.builder.discard(Box::new(scrap)));
            self.builder.discard(old);
            return reply(around.link, &header, around.tick, Verdict::Accepted, "in force");
        }
        // What was condemned is nothing to go back to.
        if condemned.is_none() {
            self.former = Some(before.clone());
        }
        let kept = (before, old);
        let scrap = if condemned.is_none() { self.previous.replace(kept) } else { Some(kept) };
        if let Some(scrap) = scrap {
            self.builder.discard(Box::new(scrap));
        }
        self.current = Some(header);
        reply(around.link, &header, around.tick, Verdict::Accepted, "in use");
    }

    fn refuse(&mut self, link: &mut RuntimeLink, header: &SnapshotHeader, verdict: Verdict, text: &str) {
        self.refused += 1;
        self.note(text);
        reply(link, header, 0, verdict, text);
    }

    fn note(&mut self, text: &str) {
        if self.refusals.len() < KEPT {
            self.refusals.push(text.to_owned());
        }
    }
}

fn supersede(link: &mut RuntimeLink, header: &SnapshotHeader) {
    let text = format!("snapshot version {} was overtaken by a newer one before its turn", header.version);
    reply(link, header, 0, Verdict::Superseded, &text);
}

fn reply(link: &mut RuntimeLink, header: &SnapshotHeader, tick: u64, verdict: Verdict, text: &str) {
    let mut receipt = ReceiptMessage::answer(header, verdict, text);
    receipt.tick = tick;
    link.send_receipt(&mut receipt);
}
