"""CleanRL-style PPO in JAX on EnvPool: jitted policy step, whole update (GAE, epochs, minibatches) in one jitted scan."""
import envpool
import jax
import jax.numpy as jnp
import numpy as np
import optax

from common import Meter, arguments

GAMMA, LAM, CLIP = 0.99, 0.95, 0.2


def mlp_init(key, sizes, last):
    ks = jax.random.split(key, len(sizes) - 1)
    gain = [2**0.5] * (len(sizes) - 2) + [last]
    return [(jax.nn.initializers.orthogonal(g)(k, (i, o)), jnp.zeros(o))
            for k, i, o, g in zip(ks, sizes, sizes[1:], gain)]


def mlp(p, x):
    for w, b in p[:-1]:
        x = jnp.tanh(x @ w + b)
    return x @ p[-1][0] + p[-1][1]


def log_prob(p, obs, act):
    z = (act - mlp(p["pi"], obs)) * jnp.exp(-p["logstd"])
    return (-0.5 * z * z - p["logstd"] - 0.5 * np.log(2 * np.pi)).sum(-1)


@jax.jit
def act_fn(p, key, obs):
    key, k = jax.random.split(key)
    mean = mlp(p["pi"], obs)
    a = mean + jnp.exp(p["logstd"]) * jax.random.normal(k, mean.shape)
    return key, a, log_prob(p, obs, a), mlp(p["v"], obs)[..., 0]


class Norm:
    def __init__(self, shape):
        self.mean, self.var, self.n = np.zeros(shape), np.ones(shape), 1e-4

    def update(self, x):
        m, v, k = x.mean(0), x.var(0), len(x)
        d, tot = m - self.mean, self.n + k
        self.var = (self.var * self.n + v * k + d * d * self.n * k / tot) / tot
        self.mean, self.n = self.mean + d * k / tot, tot


def main():
    args = arguments()
    n, T = args.n_envs, args.batch // args.n_envs
    e = envpool.make(args.env, env_type="gymnasium", num_envs=n, seed=args.seed, num_threads=2)
    n_obs, n_act = e.observation_space.shape[0], e.action_space.shape[0]
    key = jax.random.PRNGKey(args.seed)
    key, k1, k2 = jax.random.split(key, 3)
    params = {"pi": mlp_init(k1, [n_obs, 32, 32, n_act], 0.01), "v": mlp_init(k2, [n_obs, 32, 32, 1], 1.0),
              "logstd": jnp.zeros(n_act)}
    opt = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(3e-4, eps=1e-5))
    opt_state = opt.init(params)

    def loss_fn(p, mb):
        obs, act, logp, adv, ret, val = mb
        ratio = jnp.exp(log_prob(p, obs, act) - logp)
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        pg = jnp.maximum(-adv * ratio, -adv * jnp.clip(ratio, 1 - CLIP, 1 + CLIP)).mean()
        v = mlp(p["v"], obs)[..., 0]
        vc = val + jnp.clip(v - val, -CLIP, CLIP)
        return pg + 0.25 * jnp.maximum((v - ret) ** 2, (vc - ret) ** 2).mean()

    @jax.jit
    def update(params, opt_state, key, obs, act, logp, val, rew, done, last_obs):
        def gae(c, x):
            nv, last = c
            r, v, d = x
            last = r + GAMMA * nv * (1 - d) - v + GAMMA * LAM * (1 - d) * last
            return (v, last), last
        last_v = mlp(params["v"], last_obs)[..., 0]
        _, adv = jax.lax.scan(gae, (last_v, jnp.zeros(n)), (rew, val, done), reverse=True)
        flat = [x.reshape((-1,) + x.shape[2:]) for x in (obs, act, logp, adv, adv + val, val)]

        def step(c, mb):
            p, s = c
            g = jax.grad(loss_fn)(p, mb)
            u, s = opt.update(g, s, p)
            return (optax.apply_updates(p, u), s), None

        def epoch(c, k):
            i = jax.random.permutation(k, args.batch)
            mbs = [x[i].reshape((-1, args.minibatch) + x.shape[1:]) for x in flat]
            return jax.lax.scan(step, c, mbs)[0], None
        key, k = jax.random.split(key)
        (params, opt_state), _ = jax.lax.scan(epoch, (params, opt_state), jax.random.split(k, args.epochs))
        return params, opt_state, key

    f = np.float32
    O, A = np.zeros((T, n, n_obs), f), np.zeros((T, n, n_act), f)
    L, V, R, D = (np.zeros((T, n), f) for _ in range(4))
    on, rn, ret, acc, finished = Norm(n_obs), Norm(()), np.zeros(n), np.zeros(n), []

    def norm(o):
        on.update(o)
        return np.clip((o - on.mean) / np.sqrt(on.var + 1e-8), -10, 10).astype(f)

    meter, steps, obs = Meter(args.seconds), 0, norm(e.reset()[0])
    while True:
        meter.tick(steps)
        if meter.is_done():
            break
        for t in range(T):
            key, a, lp, v = act_fn(params, key, obs)
            O[t], A[t], L[t], V[t] = obs, a, lp, v
            o, r, term, trunc, _ = e.step(np.clip(A[t], -1, 1))
            done = term | trunc
            acc += r
            if done.any():
                finished += acc[done].tolist()
                acc[done] = 0
            ret = ret * GAMMA + r
            rn.update(ret)
            ret[done] = 0
            R[t], D[t] = np.clip(r / np.sqrt(rn.var + 1e-8), -10, 10), done
            obs = norm(o)
        params, opt_state, key = update(params, opt_state, key, O, A, L, V, R, D, obs)
        jax.block_until_ready(params)
        steps += args.batch
    meter.report(finished)


if __name__ == "__main__":
    main()
