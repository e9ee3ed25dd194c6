//! Codes of links and of the checks of the doctor.

use nearl_controller::codes;

codes! {
    /// Why a link could not be opened or used, see [`LinkError`](crate::link::LinkError).
    LinkCode, "link" {
        Name = "link-name", "The robot name cannot be used in file names.",
            "Take 1 to 32 letters, digits, `-` or `_`.";
        Capacity = "link-capacity", "A vector of the robot does not fit into the messages.",
            "Raise the capacity in link/messages.rs and rebuild both ends.";
        Announced = "link-announced", "A plant says of itself what no robot is.",
            "Name each joint once, in the order of v.";
        NoPlant = "link-no-plant", "No plant of this name answers on this machine.",
            "Start `nearl plant TASK --name NAME` first, or correct --plant.";
        NoRuntime = "link-no-runtime", "No runtime of this name answers on this machine.",
            "Start `nearl run SNAPSHOT --plant NAME` first.";
        NoQuestion = "link-no-question", "No loop of this name asks for proposals.",
            "Start `nearl run SNAPSHOT --plant NAME --proposer` first.";
        Taken = "link-taken", "The robot already has a plant, runtime, trainer or proposer.",
            "Stop that process first, or use another name.";
        Full = "link-full", "There is no free place for another reader.", "Close a viewer or log reader.";
        Schema = "link-schema", "The other end was built with another message layout.",
            "Run plant, runtime and trainer from the same build.";
        Memory = "link-memory", "Shared memory has too little room.", "Free space in /dev/shm or remount it larger.";
        MemoryMissing = "link-memory-missing", "Shared memory is missing or cannot be written.",
            "Mount a writable tmpfs at /dev/shm.";
        Foreign = "link-foreign", "A file or folder of the links is another user's, a link, a pipe, or open to others.",
            "Find out who made it, then remove it; see docs/SECURITY.md.";
        Transport = "link-transport", "iceoryx2 failed for another reason.",
            "If no nearl process of the robot is alive, delete the files the sentence names and try again.";
    }
}

codes! {
    /// Checks of `nearl doctor`.
    CheckCode, "doctor" {
        Snapshot = "doctor-snapshot", "Can the snapshot file be read, and is it whole?",
            "Do what the sentence says; `nearl explain` knows its reason.";
        Canary = "doctor-canary", "Do trial states give finite actions?", "Use an earlier snapshot.";
        Model = "doctor-model", "Does the model hold everything that the robot file describes?",
            "Do what the sentence says. What only the robot file has, take out of it, or leave a margin for it.";
        Projection = "doctor-projection", "Are the policy's targets projected into the limits?",
            "Add constraints.guard = true, or train with an algorithm that proposes states.";
        Holding = "doctor-holding", "Can the motors hold the robot still everywhere within its position limits?",
            "Raise constraints.torque.scale, or narrow the position limits to where the motors can.";
        Recipe = "doctor-recipe", "What does a policy made elsewhere see, and what do its outputs mean?",
            "Import the policy again with another recipe.";
        Braking = "doctor-braking", "Can the motors give the decelerations that the position limits count on?",
            "Set constraints.braking = \"stored\", or multiply constraints.acceleration.limit by the number in the sentence.";
        Gains = "doctor-gains", "How well must the gains of the joints' drives be known?",
            "Measure the gains, or lower the drives' damping or the speed limits, or raise constraints.acceleration.limit.";
        Reached = "doctor-reached", "Which share of ticks may end outside a position limit, and can the motors keep to it?",
            "Ask for a larger constraints.reached, or leave the limits named room for what the motors cannot hold.";
        Memory = "doctor-memory", "Is there room for the links in /dev/shm?", "Free space there or remount it larger.";
        Links = "doctor-links", "Are there links that only dead processes hold?",
            "Start the robot again, which cleans up, or delete the files the sentence names.";
        Priority = "doctor-priority", "Is real-time priority granted?",
            "Run with CAP_SYS_NICE, or raise rtprio in /etc/security/limits.conf.";
        Lock = "doctor-lock", "Can memory be locked?", "Raise the limit with `ulimit -l unlimited`.";
        Clock = "doctor-clock", "Does the monotonic clock count finely enough?",
            "Boot with high-resolution timers (CONFIG_HIGH_RES_TIMERS).";
        WakeUp = "doctor-wake-up", "Does an empty loop wake up in time?",
            "Stop other programs, or keep a core free and give it with --cpu.";
        Plant = "doctor-plant", "Does the plant answer, and is it the robot of the snapshot?",
            "Start the plant with the snapshot's task.";
    }
}
