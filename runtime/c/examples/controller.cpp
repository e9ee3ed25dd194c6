// The controller inside a C++ program: `controller SNAPSHOT` runs it on a carriage of 2 kg for two seconds of simulated time.
#include <nearl.h>

#include <cmath>
#include <cstdio>
#include <memory>
#include <vector>

int main(int argc, char **argv) {
    char error[256] = "usage: controller SNAPSHOT";
    auto load = [&] { return argc == 2 ? nearl_controller_load(argv[1], error, sizeof error) : nullptr; };
    std::unique_ptr<nearl_controller, decltype(&nearl_controller_free)> controller(load(), nearl_controller_free);
    if (!controller) return std::fprintf(stderr, "%s\n", error), 1;

    const nearl_sizes sizes = nearl_controller_sizes(controller.get());
    std::vector<double> q(sizes.nq), v(sizes.nv), obs(sizes.n_obs), action(sizes.n_act);
    double farthest = 0, fastest = 0;
    nearl_ledger ledger{};
    for (int tick = 0; tick < 2000; tick++) {
        obs = {q[0], v[0]};
        const int status = nearl_controller_update(controller.get(), q.data(), v.data(), obs.data(), action.data(), &ledger);
        if (status < 0 || ledger.target_violations > 0) return std::fprintf(stderr, "tick %d: %s\n", tick, nearl_status_name(status)), 1;
        v[0] += sizes.dt * action[0] / 2.0;
        q[0] += sizes.dt * v[0];
        farthest = std::fmax(farthest, std::fabs(q[0]));
        fastest = std::fmax(fastest, std::fabs(v[0]));
    }
    std::printf("%.6f %.6f %s\n", farthest, fastest, nearl_status_name(ledger.status));
}
