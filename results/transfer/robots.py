"""The robots of this folder: what a training draws, and the plants that its policies meet. Each is a list of `--set`."""

NOISE = {
    "panda": ['noise.q="0.002 * normal"', 'noise.v="0.02 * normal"'],
    "anymal": [
        'noise.q="0.01 * uniform"',
        'noise.v="0.5 * uniform"',
        'noise.base_v="0.1 * uniform"',
        'noise.base_w="0.2 * uniform"',
        'noise.tilt="0.02 * normal"',
    ],
}

# What a randomised training draws in each episode.
RANDOM = {
    "panda": [
        'random.mass="1 + 0.2 * uniform"',
        'random.strength="0.9 + 0.1 * uniform"',
        'delay.action="1 + uniform"',
        *NOISE["panda"],
    ],
    "anymal": [
        'random.mass="1 + 0.2 * uniform"',
        'random.com={ base_inertia = "0.03 * uniform" }',
        'random.friction="1 + 0.4 * uniform"',
        'random.strength="0.9 + 0.1 * uniform"',
        'random.stiffness="1 + 0.1 * uniform"',
        'random.damping="1 + 0.2 * uniform"',
        'delay.action="1 + uniform"',
        *NOISE["anymal"],
    ],
}


def plants(robot):
    """Plants by name: nothing of the training's own draws is left but commands, pushes and starts."""
    calm = ["random={}", "noise={}", "delay={}"]
    one = {
        "as trained without": [],
        "masses 20 % up": ["random.mass=1.2"],
        "masses 20 % down": ["random.mass=0.8"],
        "2 ticks of delay": ["delay.action=2"],
        "noise": NOISE[robot],
        "motors at 80 %": ["random.strength=0.8"],
        "all of these": ["random.mass=1.2", "random.strength=0.8", "delay.action=2", *NOISE[robot]],
    }
    return {name: calm + sets for name, sets in one.items()}
