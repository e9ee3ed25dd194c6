"""CleanRL-style PPO in JAX on EnvPool: jitted policy step, whole update (GAE, epochs, minibatches) in one jitted scan.

`--tell STEPS` prints `{"steps": ..., "return": ...}` after each batch instead of a rate, while the learning rate falls to zero over so many steps.
"""
import json

import envpool
import jax
import jax.numpy as jnp
import numpy as np
import optax

from common import Meter, parser

GAMMA, CLIP = 0.99, 0.2


def arguments():
    p = parser()
    p.add_argument("--nets", type=json.loads, default=[32, 32])
    p.add_argument("--lr", type=float, default=3e-4)
    p.add_argument("--log-std", type=float, default=0.0)
    p.add_argument("--gae-lambda", type=float, default=0.95)
    p.add_argument("--target-kl", type=float, default=0.0, help="no further pass over a batch once its divergence is 1.5 times this; 0: all of them")
    p.add_argument("--tell", type=int, default=0, metavar="STEPS")
    return p.parse_args()


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
    params = {"pi": mlp_init(k1, [n_obs, *args.nets, n_act], 0.01), "v": mlp_init(k2, [n_obs, *args.nets, 1], 1.0),
              "logstd": jnp.full(n_act, args.log_std, jnp.float32)}
    opt = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1.0, eps=1e-5))
    opt_state = opt.init(params)

    def loss_fn(p, mb):
        obs, act, logp, adv, ret, val = mb
        ratio = jnp.exp(log_prob(p, obs, act) - logp)
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        pg = jnp.maximum(-adv * ratio, -adv * jnp.clip(ratio, 1 - CLIP, 1 + CLIP)).mean()
        v = mlp(p["v"], obs)[..., 0]
        vc = val + jnp.clip(v - val, -CLIP, CLIP)
        return pg + 0.25 * jnp.maximum((v - ret) ** 2, (vc - ret) ** 2).mean()

    def rows(params, obs, act, logp, val, rew, done, last_obs):
        def gae(c, x):
            nv, last = c
            r, v, d = x
            last = r + GAMMA * nv * (1 - d) - v + GAMMA * args.gae_lambda * (1 - d) * last
            return (v, last), last
        last_v = mlp(params["v"], last_obs)[..., 0]
        _, adv = jax.lax.scan(gae, (last_v, jnp.zeros(n)), (rew, val, done), reverse=True)
        return [x.reshape((-1,) + x.shape[2:]) for x in (obs, act, logp, adv, adv + val, val)]

    def epoch(c, lr, flat, k):
        def step(c, mb):
            p, s = c
            g = jax.grad(loss_fn)(p, mb)
            u, s = opt.update(g, s, p)
            return (optax.apply_updates(p, jax.tree.map(lambda x: lr * x, u)), s), None
        i = jax.random.permutation(k, args.batch)
        mbs = [x[i].reshape((-1, args.minibatch) + x.shape[1:]) for x in flat]
        return jax.lax.scan(step, c, mbs)[0]

    @jax.jit
    def update(params, opt_state, key, lr, *batch):
        flat = rows(params, *batch)
        key, k = jax.random.split(key)
        scan = lambda c, k: (epoch(c, lr, flat, k), None)
        (params, opt_state), _ = jax.lax.scan(scan, (params, opt_state), jax.random.split(k, args.epochs))
        return params, opt_state, key

    rows_of = jax.jit(rows)

    @jax.jit
    def one(params, opt_state, key, lr, flat):
        """A pass over the batch, and how far the policy is from the one that collected it."""
        key, k = jax.random.split(key)
        params, opt_state = epoch((params, opt_state), lr, flat, k)
        d = log_prob(params, flat[0], flat[1]) - flat[2]
        return params, opt_state, key, (jnp.exp(d) - 1 - d).mean()

    def until(params, opt_state, key, lr, *batch):
        flat = rows_of(params, *batch)
        for _ in range(args.epochs):
            params, opt_state, key, kl = one(params, opt_state, key, lr, flat)
            if kl > 1.5 * args.target_kl:
                break
        return params, opt_state, key

    learn = until if args.target_kl else update

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
        if steps >= args.tell if args.tell else meter.is_done():
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
        lr = f(args.lr * (1 - steps / args.tell) if args.tell else args.lr)
        params, opt_state, key = learn(params, opt_state, key, lr, O, A, L, V, R, D, obs)
        jax.block_until_ready(params)
        steps += args.batch
        if args.tell:
            last = finished[-100:]
            print(json.dumps({"steps": steps, "return": sum(last) / len(last) if last else None}), flush=True)
    if not args.tell:
        meter.report(finished)


if __name__ == "__main__":
    main()
