//! How the projection of a tick ended, and why a snapshot was refused.

codes! {
    /// How the projection of a tick ended, as messages and the flight log have it.
    LedgerStatus, "status" {
        Unchanged = "unchanged", "The proposal obeys every limit and was passed on bit for bit.", "Nothing to do.";
        Clamped = "clamped", "The proposal was moved to the nearest allowed state, joint by joint.", "Nothing to do.";
        Solved = "solved", "Torque rows were active; the nearest allowed state was solved for and checked.", "Nothing to do.";
        Recovering = "recovering", "A joint, frame, pair of bodies or row is outside its limits: it may only come back or brake.",
            "See which in `outside` of the ledger (Python, `nearl project`); the limits of the task may be narrower than where the robot stood.";
        Slowed = "slowed", "No way to stop could be verified from the nearest allowed state, or its physics steps do not lead there; the target is another.",
            "Nothing to do; if it happens often, lower acceleration or the proposals' size.";
        BrakedNonFiniteProposal = "braked-non-finite-proposal", "The proposal held NaN or infinity; every joint brakes.",
            "Go back to an earlier snapshot: the training diverged.";
        BrakedNoCertifiedAnswer = "braked-no-certified-answer", "No target passed the checker; every joint brakes.",
            "The torque limits leave nothing to do there: run `nearl doctor SNAPSHOT` and loosen what it names.";
        BrakedNoVerifiedBrake = "braked-no-verified-brake", "No way to stop could be verified; the stored brake is executed.",
            "If it happens often, lower acceleration or the proposals' size; if it lasts, a joint cannot be held: see `holding` of `nearl doctor SNAPSHOT`.";
        BrakedNonFiniteDynamics = "braked-non-finite-dynamics", "The dynamics gave NaN or infinity; every joint brakes.",
            "Check the robot file's masses and the plant's velocities.";
        RefusedNonFiniteState = "refused-non-finite-state", "The measured state held NaN or infinity.",
            "Check the plant's sensors.";
        ActionsBounded = "actions-bounded",
            "The policy gives actions, and these were kept within limits of their own or within what the drives' motors allow; nothing was projected.",
            "Write `[constraints] guard = true` where limits on the motion matter.";
        NotProjected = "not-projected", "The policy gives actions and proposes no state: nothing was projected, and no limit was looked at.",
            "Train with an algorithm that proposes states (`nearl train TASK --algo pid2-ib`) where limits matter.";
        RefusedWrongLength = "refused-wrong-length", "The state does not have the robot's number of entries.",
            "Start plant and runtime with the same robot file.";
        Tightening = "tightening", "Limits were moved, and the robot is on the declared way to them.",
            "Nothing to do; what is not reached is in `outside` of the ledger, and a joint behind a position comes back with the proposal.";
    }
}

impl LedgerStatus {
    /// The number in messages: 0 to 4 and 6 projected, 5 and 7 not, 10 and up braked, 20 and up refused.
    pub fn number(self) -> u32 {
        match self {
            LedgerStatus::BrakedNonFiniteProposal => 10,
            LedgerStatus::BrakedNoCertifiedAnswer => 11,
            LedgerStatus::BrakedNonFiniteDynamics => 12,
            LedgerStatus::BrakedNoVerifiedBrake => 13,
            LedgerStatus::NotProjected => 5,
            LedgerStatus::Tightening => 6,
            LedgerStatus::ActionsBounded => 7,
            LedgerStatus::RefusedNonFiniteState => 20,
            LedgerStatus::RefusedWrongLength => 21,
            plain => plain.code(),
        }
    }
}

codes! {
    /// Why a snapshot file was refused, see [`SnapshotError`](crate::SnapshotError).
    SnapshotCode, "snapshot" {
        Unreadable = "snapshot-unreadable", "The file is missing, unreadable, not a regular file, or too large.",
            "Give a .safetensors file written by `nearl train`.";
        Malformed = "snapshot-malformed", "Not a safetensors file, or cut short.", "Copy the file again.";
        Foreign = "snapshot-foreign", "A safetensors file without the manifest of this program, or of another format.",
            "Write it with `nearl train` of this build.";
        Digest = "snapshot-digest", "The digest in the file does not match its content.",
            "The file was changed or damaged: copy it again.";
        MissingTensor = "snapshot-missing-tensor", "A tensor that must be there is not.",
            "Train again, or convert the file with the build that wrote it.";
        Shape = "snapshot-shape", "A tensor has another type or shape than the task needs.",
            "Use a snapshot of this task.";
        Value = "snapshot-value", "A weight is NaN, infinite or huge, or a standard deviation is not positive.",
            "Use an earlier snapshot: the training diverged.";
        Unusable = "snapshot-unusable", "The robot, layout or limits inside are refused.",
            "Correct what the sentence names in the task file, and train or export again.";
        Canary = "snapshot-canary", "A trial inference at rest gave something that is not a number.",
            "Use an earlier snapshot: the weights are unusable.";
    }
}
