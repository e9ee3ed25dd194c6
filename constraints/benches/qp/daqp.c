/* Thread CPU time of DAQP on the problems of gen.py: daqp FILE.bin OUT.txt. The workspace is kept from problem to problem, so each
 * solve starts from the working set of the last. Timed: taking over f, A and the bounds, and the solve. */
#include "api.h"
#include "utils.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { PASSES = 11 };

static long now(void) {
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return t.tv_sec * 1000000000L + t.tv_nsec;
}

static int ascending(const void *a, const void *b) {
    long x = *(const long *)a, y = *(const long *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    if (argc != 3) return fprintf(stderr, "usage: daqp FILE.bin OUT.txt\n"), 2;
    FILE *file = fopen(argv[1], "rb");
    if (!file) return perror(argv[1]), 1;
    unsigned long head[2];
    if (fread(head, 8, 2, file) != 2) return 1;
    int n = (int)head[0], count = (int)head[1], record = 6 * n + n * n;
    double *data = malloc(sizeof(double) * record * count);
    if (fread(data, 8, (size_t)record * count, file) != (size_t)record * count) return 1;

    double *H = calloc(n * n, 8), *f = malloc(8 * n), *upper = malloc(16 * n), *lower = malloc(16 * n);
    int *sense = calloc(2 * n, sizeof(int));
    double x[64], lam[128];
    for (int i = 0; i < n; i++) H[i * n + i] = 1;
    DAQPProblem qp = {0};
    qp.n = n, qp.m = 2 * n, qp.ms = n, qp.H = H, qp.f = f, qp.bupper = upper, qp.blower = lower, qp.sense = sense;
    DAQPWorkspace work;
    memset(&work, 0, sizeof work);
    DAQPResult result = {0};
    result.x = x, result.lam = lam;

    long *times = malloc(sizeof(long) * PASSES * count), clocks[2001];
    for (int i = 0; i < 2001; i++) { long t = now(); clocks[i] = now() - t; }
    qsort(clocks, 2001, sizeof(long), ascending);
    double furthest = 0, steps = 0;
    int failed = 0;
    for (int pass = 0; pass < PASSES; pass++)
        for (int k = 0; k < count; k++) {
            double *d = data + (size_t)record * k, *rows = d + 3 * n, *optimum = rows + n * n + 2 * n;
            for (int i = 0; i < n; i++) f[i] = -d[i];
            memcpy(lower, d + n, 8 * n), memcpy(upper, d + 2 * n, 8 * n);
            memcpy(lower + n, rows + n * n, 8 * n), memcpy(upper + n, rows + n * n + n, 8 * n);
            qp.A = rows;
            int flag = 0;
            if (!pass && !k) {
                if (setup_daqp(&qp, &work, NULL) < 0) return fprintf(stderr, "set-up failed\n"), 1;
                work.settings->primal_tol = 1e-9;
            }
            long start = now();
            flag = daqp_update_ldp(DAQP_UPDATE_M | DAQP_UPDATE_v | DAQP_UPDATE_d, &work, &qp);
            if (flag >= 0) daqp_solve(&result, &work);
            times[k * PASSES + pass] = now() - start - clocks[1000];
            if (pass == PASSES - 1) {
                failed += flag < 0 || result.exitflag <= 0, steps += result.iter;
                for (int i = 0; i < n; i++) furthest = fmax(furthest, fabs(x[i] - optimum[i]));
            }
        }
    FILE *out = fopen(argv[2], "w");
    if (!out) return perror(argv[2]), 1;
    fprintf(out, "# failed %d furthest %e steps %f\n", failed, furthest, steps / count);
    for (int k = 1; k < count; k++) {
        qsort(times + k * PASSES, PASSES, sizeof(long), ascending);
        fprintf(out, "%.3f\n", times[k * PASSES + PASSES / 2] / 1000.0);
    }
    return fclose(out);
}
