//! Snapshots on their way into the loop: from bytes to a built controller to the swap, with one receipt for each.

use crate::link::{
    Message, ReceiptMessage, RobotMessage, RuntimeLink, SnapshotBytes, SnapshotHeader, Verdict,
};
use crate::rt::build::Builder;
use crate::rt::swap::Sender;
use crate::rt::tick::{Build, Tick};

/// How many refusals are kept as text for the report.
const KEPT: usize = 32;

/// The I/O thread's side of the hot swap.
pub(crate) struct SnapshotInbox<B: Build> {
    builder: Builder<B>,
    swap: Sender<B::Controller>,
    /// Built, not yet offered to the loop.
    ready: Option<(SnapshotHeader, Box<B::Controller>)>,
    /// In the slot, not yet taken by the loop.
    offered: Option<(SnapshotHeader, u64)>,
    /// Sender and version of the newest snapshot that came.
    newest: (u64, u64),
    /// Versions taken into use: (first tick at the latest, version of the controller).
    pub(crate) accepted: Vec<(u64, u64)>,
    /// Sentences of refusals, the first ones.
    pub(crate) refusals: Vec<String>,
    /// Snapshots refused.
    pub(crate) refused: u64,
}

impl<B: Build> SnapshotInbox<B> {
    pub(crate) fn new(builder: Builder<B>, swap: Sender<B::Controller>) -> SnapshotInbox<B> {
        SnapshotInbox {
            builder,
            swap,
            ready: None,
            offered: None,
            newest: (0, 0),
            accepted: Vec::new(),
            refusals: Vec::new(),
            refused: 0,
        }
    }

    /// Moves every snapshot one stage on; `tick` is the newest tick known.
    pub(crate) fn pump(&mut self, link: &mut RuntimeLink, robot: &RobotMessage, tick: u64) {
        self.settle(link, tick);
        if let Some(snapshot) = link.newest_snapshot() {
            self.receive(link, snapshot, robot);
        }
        if let Some(built) = self.builder.collect() {
            match built.result {
                Err(refusal) => self.refuse(link, &built.header, refusal.verdict, &refusal.text),
                Ok(controller) => {
                    if let Some((header, _)) = self.ready.replace((built.header, controller)) {
                        self.supersede(link, &header);
                    }
                }
            }
        }
        self.offer();
    }

    fn receive(&mut self, link: &mut RuntimeLink, snapshot: SnapshotBytes, robot: &RobotMessage) {
        let (sender, version) = (snapshot.header.header.epoch, snapshot.header.version);
        if sender == self.newest.0 && version <= self.newest.1 {
            let text = format!(
                "snapshot version {version} came after version {}: give each push a higher version",
                self.newest.1
            );
            return self.refuse(link, &snapshot.header, Verdict::Outdated, &text);
        }
        self.newest = (sender, version);
        if let Some(replaced) = self.builder.take(snapshot, *robot) {
            self.supersede(link, &replaced);
        }
    }

    fn offer(&mut self) {
        if self.offered.is_some() {
            return;
        }
        if let Some((header, controller)) = self.ready.take() {
            let version = controller.version();
            match self.swap.offer(controller) {
                Ok(()) => self.offered = Some((header, version)),
                Err(controller) => self.ready = Some((header, controller)),
            }
        }
    }

    /// The old controller came back: the new one is in use. The old one is dropped here.
    fn settle(&mut self, link: &mut RuntimeLink, tick: u64) {
        let Some(old) = self.swap.collect() else { return };
        drop(old);
        if let Some((header, version)) = self.offered.take() {
            self.accepted.push((tick, version));
            reply(link, &header, tick, Verdict::Accepted, "in use");
        }
    }

    fn supersede(&mut self, link: &mut RuntimeLink, header: &SnapshotHeader) {
        let text =
            format!("snapshot version {} was overtaken by a newer one before its turn", header.version);
        reply(link, header, 0, Verdict::Superseded, &text);
    }

    fn refuse(&mut self, link: &mut RuntimeLink, header: &SnapshotHeader, verdict: Verdict, text: &str) {
        self.refused += 1;
        if self.refusals.len() < KEPT {
            self.refusals.push(text.to_owned());
        }
        reply(link, header, 0, verdict, text);
    }
}

fn reply(link: &mut RuntimeLink, header: &SnapshotHeader, tick: u64, verdict: Verdict, text: &str) {
    let mut receipt = ReceiptMessage::zeroed();
    receipt.trainer_epoch = header.header.epoch;
    receipt.version = header.version;
    receipt.tick = tick;
    receipt.set(verdict, text);
    link.send_receipt(&mut receipt);
}
