/* NEARL for C and C++: a robot's driver as the plant of a loop, and the controller inside a program of one's own.
 *
 * Link with -lnearl_c. Arrays belong to the caller; nothing is kept after a call. A handle is used by one thread at a time.
 * Calls that can fail take a buffer for one sentence: `error` of `error_size` bytes, may be NULL. See docs/CONNECT.md.
 */
#ifndef NEARL_H
#define NEARL_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- plant ------------------------------------------------------------------------------------------------------- */

/* What the driver is to do in a period. */
#define NEARL_ACT 0   /* apply `action`, computed from the state just given */
#define NEARL_HOLD 1  /* none came in time: apply `action`, that of before; where it is a position, slow down instead (docs/CONNECT.md) */
#define NEARL_BRAKE 2 /* bring the robot to rest: no loop, a silent one, or it leaves braking to the plant */

typedef struct nearl_plant nearl_plant;

/* What the plant is; a snapshot for another robot is refused. */
typedef struct nearl_robot {
    const char *const *joints;      /* names in the order of v */
    size_t n_joints;
    const char *const *observation; /* names of the observation's entries */
    size_t n_obs;
    size_t nq, nv, nu;              /* numbers of a configuration, a velocity, an action */
    double dt;                      /* control period [s] */
    double watchdog;                /* time without a fresh action after which the plant brakes [s] */
    int lockstep;                   /* not 0: time stands still until an action comes (simulators) */
} nearl_robot;

/* One sample; lengths are those of the robot. */
typedef struct nearl_state {
    double time;         /* the plant's own clock [s]; 0 where it has none */
    const double *q;     /* configuration (nq) */
    const double *v;     /* velocity (nv) */
    const double *obs;   /* observation (n_obs) */
    uint64_t episode;    /* number of the episode; 0 for a robot that is never reset */
    int begins;          /* not 0: this state begins an episode */
    int braked;          /* not 0: since the state before the driver braked by itself, or something held the robot (emergency stop) */
} nearl_state;

/* Opens the plant `name`; NULL and a sentence where it cannot. */
nearl_plant *nearl_plant_open(const char *name, const nearl_robot *robot, char *error, size_t error_size);

/* Gives the state to the loop and waits at most `patience` seconds for its action (nu). NEARL_ACT, NEARL_HOLD or NEARL_BRAKE, where
 * `action` stays as it was; below 0 for a NULL pointer or a patience that is no number, where the driver should brake too. */
int nearl_plant_exchange(nearl_plant *plant, const nearl_state *state, double patience, double *action);

/* Leaves; the loop sees that the plant is gone. NULL is allowed. */
void nearl_plant_close(nearl_plant *plant);

/* ---- proposer ---------------------------------------------------------------------------------------------------- */

/* A process that proposes in place of the policy of `nearl run SNAPSHOT --plant NAME --proposer`, at its own rate. */
typedef struct nearl_proposer nearl_proposer;

/* Waits at most `patience` seconds for the loop of `name`; NULL and a sentence where there is none, or it has a proposer. */
nearl_proposer *nearl_proposer_open(const char *name, double patience, char *error, size_t error_size);

/* How many entries a proposal has. */
size_t nearl_proposer_entries(const nearl_proposer *proposer);

/* Name of the k-th: "q.JOINT", "v.JOINT" of a state, "JOINT" of an action. It lasts as long as the handle; NULL beyond the end. */
const char *nearl_proposer_entry(const nearl_proposer *proposer, size_t k);

/* 1 where a proposal is an action, 0 where it is a state to be reached; below 0 for NULL. */
int nearl_proposer_is_action(const nearl_proposer *proposer);

/* The newest state that was not read before, waiting at most `patience` seconds: 1, or 0 where none came. What is proposed next answers it.
 * Each array has the robot's length, or length 0 where it is not wanted; any other is refused, below 0, as a patience that is no number is. */
int nearl_proposer_state(nearl_proposer *proposer, double patience, double *q, size_t nq, double *v, size_t nv, double *obs, size_t n_obs);

/* Proposes n values in the order of the entries: 0, or below 0 where their number is another one. */
int nearl_proposer_propose(nearl_proposer *proposer, const double *values, size_t n);

/* Leaves: the loop holds the last proposal for a while, then brakes. NULL is allowed. */
void nearl_proposer_close(nearl_proposer *proposer);

/* ---- controller -------------------------------------------------------------------------------------------------- */

typedef struct nearl_controller nearl_controller;

typedef struct nearl_sizes {
    size_t nq, nv, n_obs, n_act;
    size_t policy_every; /* control ticks in a period of the policy */
    double dt;           /* control period [s] */
} nearl_sizes;

/* What the projection did in a tick. */
typedef struct nearl_ledger {
    int32_t status;               /* see nearl_status_name */
    uint32_t active;              /* rows that hold the target back */
    uint32_t iterations;          /* of the solver */
    uint32_t raw_violations;      /* limits that the raw proposal broke */
    uint32_t target_violations;   /* limits that the target breaks, by the independent check */
    uint32_t reserved;
    double moved;                 /* weighted distance between proposal and target */
    double slack;                 /* largest slack of a soft row */
    uint64_t duration_ns;         /* of the whole update */
} nearl_ledger;

/* Reads and validates a snapshot; NULL and a sentence where it is refused. */
nearl_controller *nearl_controller_load(const char *snapshot, char *error, size_t error_size);

/* The sizes of its arrays. */
nearl_sizes nearl_controller_sizes(const nearl_controller *controller);

/* One control tick without noise: the action (n_act) for q (nq), v (nv) and obs (n_obs). Returns the status; what is below 0 is refused, and the
 * action is then that of the last finite state: brake if it lasts. Before the first finite state `action` and `ledger` stay as they were.
 * `ledger` may be NULL. Nothing is allocated. */
int nearl_controller_update(nearl_controller *controller, const double *q, const double *v, const double *obs, double *action,
                            nearl_ledger *ledger);

/* A new episode, or a pause in which the robot did something else than it was sent: the next tick is one of the policy's, and begins where the
 * robot is. */
void nearl_controller_reset(nearl_controller *controller);

/* NULL is allowed. */
void nearl_controller_free(nearl_controller *controller);

/* "unchanged", "clamped", "solved", "recovering", "slowed", "braked", "tightening", "refused"; "unknown" for any other number. */
const char *nearl_status_name(int status);

/* Version of the library, as "0.1.0". */
const char *nearl_version(void);

#ifdef __cplusplus
}
#endif
#endif
