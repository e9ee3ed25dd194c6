/* A carriage of 2 kg on a rail, driven by a force: a complete driver. Usage: driver NAME TICKS */
#include <nearl.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: driver NAME TICKS\n"), 2;
    const char *joints[] = {"slide"}, *observation[] = {"q.slide", "v.slide"};
    const nearl_robot robot = {joints, 1, observation, 2, 1, 1, 1, .dt = 0.001, .watchdog = 0.02, .lockstep = 1};
    char error[256];
    nearl_plant *plant = nearl_plant_open(argv[1], &robot, error, sizeof error);
    if (!plant) return fprintf(stderr, "%s\n", error), 1;

    double q = 0.0, v = 0.0, force = 0.0, farthest = 0.0, fastest = 0.0; /* the robot */
    long acted = 0, braked = 0, ticks = atol(argv[2]);
    for (long tick = 0; acted < ticks && braked < 100; tick++) {
        double obs[] = {q, v}; /* 1. measure */
        nearl_state state = {.time = tick * robot.dt, .q = &q, .v = &v, .obs = obs, .begins = tick == 0};
        switch (nearl_plant_exchange(plant, &state, 0.3, &force)) { /* 2. ask */
        case NEARL_ACT: acted++; break;
        case NEARL_HOLD: break;                             /* `force` is that of before; a position would stop the robot at once */
        default: force = -2.0 * v / robot.dt, braked++;     /* 3. brake by itself */
        }
        if (force > 40.0) force = 40.0; /* the motor's own limit */
        if (force < -40.0) force = -40.0;
        v += robot.dt * force / 2.0, q += robot.dt * v; /* 4. actuate */
        if (q > farthest) farthest = q;
        if (-q > farthest) farthest = -q;
        if (v > fastest) fastest = v;
        if (-v > fastest) fastest = -v;
    }
    printf("%ld %ld %.6f %.6f\n", acted, braked, farthest, fastest);
    nearl_plant_close(plant);
    return acted == ticks ? 0 : 1;
}
