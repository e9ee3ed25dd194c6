/* A process that proposes in place of a policy: always far beyond where the robot may go. Usage: proposer NAME PROPOSALS */
#include <nearl.h>
#include <stdio.h>
#include <stdlib.h>

int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: proposer NAME PROPOSALS\n"), 2;
    char error[256];
    nearl_proposer *proposer = nearl_proposer_open(argv[1], 30.0, error, sizeof error);
    if (!proposer) return fprintf(stderr, "%s\n", error), 1;

    double q, v, side = 1.0, proposal[64];
    size_t n = nearl_proposer_entries(proposer);
    long proposed = 0, proposals = atol(argv[2]);
    while (proposed < proposals && n <= 64) {
        if (nearl_proposer_state(proposer, 1.0, &q, 1, &v, 1, NULL, 0) != 1) break; /* no plant any more */
        side = q > 0.3 ? -1.0 : q < -0.2 ? 1.0 : side;
        for (size_t k = 0; k < n; k++) {
            int is_speed = nearl_proposer_entry(proposer, k)[0] == 'v'; /* "q.slide", "v.slide" */
            proposal[k] = side * (is_speed ? 9.0 : 5.0);
        }
        if (nearl_proposer_propose(proposer, proposal, n) == 0) proposed++;
    }
    nearl_proposer_close(proposer);
    return printf("%ld\n", proposed), proposed == proposals ? 0 : 1;
}
