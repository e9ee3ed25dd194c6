//! f32 kernels for matrices of the size of small networks.
//!
//! A row is padded to whole vectors of 16 lanes, a weight matrix to 8 rows, so there are no tail loops.
//! Lanes run over output features and every element's sum runs over `k` in order, so no result depends on
//! the width of the processor's vectors: the baseline, AVX2 and AVX-512 give the same bits.

use super::activation::Activation;
use std::sync::atomic::{AtomicU8, Ordering};

/// Lanes of one vector.
pub const LANES: usize = 16;

/// Sixteen lanes.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct V(pub [f32; LANES]);

/// All lanes zero.
pub const ZERO: V = V([0.0; LANES]);

impl V {
    /// The same value in every lane.
    #[inline(always)]
    pub fn splat(x: f32) -> Self {
        Self([x; LANES])
    }
    /// Lane by lane.
    #[inline(always)]
    pub fn map(self, f: impl Fn(f32) -> f32) -> Self {
        let mut out = self;
        for l in 0..LANES {
            out.0[l] = f(self.0[l]);
        }
        out
    }
    /// Lane by lane with another vector.
    #[inline(always)]
    pub fn zip(self, b: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        let mut out = self;
        for l in 0..LANES {
            out.0[l] = f(self.0[l], b.0[l]);
        }
        out
    }
    /// `self + a b`, rounded once.
    #[inline(always)]
    pub fn fma(self, a: Self, b: Self) -> Self {
        let mut out = self;
        for l in 0..LANES {
            out.0[l] = a.0[l].mul_add(b.0[l], self.0[l]);
        }
        out
    }
    /// Sum of the lanes in a fixed order (a tree).
    #[inline(always)]
    pub fn sum(self) -> f32 {
        let mut t = self.0;
        for w in [8, 4, 2, 1] {
            for l in 0..w {
                t[l] += t[l + w];
            }
        }
        t[0]
    }
}

macro_rules! lanewise {
    ($trait:ident, $method:ident, $op:tt) => {
        impl std::ops::$trait for V {
            type Output = V;
            #[inline(always)]
            fn $method(self, b: V) -> V {
                self.zip(b, |x, y| x $op y)
            }
        }
    };
}
lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);
lanewise!(Div, div, /);

/// The lanes of a slice of vectors, one after another.
pub fn scalars(v: &[V]) -> &[f32] {
    // SAFETY: `V` is 16 f32 without padding (size 64, align 64).
    unsafe { std::slice::from_raw_parts(v.as_ptr().cast(), v.len() * LANES) }
}

/// See [`scalars`].
pub fn scalars_mut(v: &mut [V]) -> &mut [f32] {
    // SAFETY: as in `scalars`.
    unsafe { std::slice::from_raw_parts_mut(v.as_mut_ptr().cast(), v.len() * LANES) }
}

/// `x` within `[lower, upper]`: two single choices, which compile to vector selects (nested ones go lane by lane).
#[inline(always)]
fn within(x: V, lower: f32, upper: f32) -> V {
    x.map(|v| if v < lower { lower } else { v }).map(|v| if v > upper { upper } else { v })
}

/// tanh by a rational minimax polynomial (13 / 6, as in Eigen); absolute error about 3e-7.
#[inline(always)]
pub fn tanh(x: V) -> V {
    const BOUND: f32 = 7.905_311;
    const N: [f32; 7] = [
        -2.760_768_5e-16,
        2.000_188e-13,
        -8.604_672e-11,
        5.122_297e-8,
        1.485_722_4e-5,
        6.372_619_3e-4,
        4.893_525e-3,
    ];
    const D: [f32; 4] = [1.198_258_4e-6, 1.185_347_1e-4, 2.268_434_6e-3, 4.893_525e-3];
    let x = within(x, -BOUND, BOUND);
    let s = x * x;
    x * horner(&N, s) / horner(&D, s)
}

/// e^x as in Cephes: range reduction and a degree-5 polynomial; relative error about 2e-7 on [-87, 88].
#[inline(always)]
pub fn exp(x: V) -> V {
    const C: [f32; 6] = [1.987_569_1e-4, 1.398_2e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer
    let x = within(x, -87.0, 88.0);
    let t = x * V::splat(std::f32::consts::LOG2_E) + V::splat(ROUND);
    let k = t - V::splat(ROUND);
    let r = x.fma(k, V::splat(-0.693_359_4)).fma(k, V::splat(2.121_944_4e-4));
    let y = (r + V::splat(1.0)).fma(horner(&C, r), r * r);
    y.zip(t, |y, t| f32::from_bits(y.to_bits().wrapping_add(t.to_bits() << 23)))
}

#[inline(always)]
fn horner(c: &[f32], x: V) -> V {
    c[1..].iter().fold(V::splat(c[0]), |a, &k| V::splat(k).fma(a, x))
}

/// What happens to a product before it is stored.
#[derive(Clone, Copy)]
pub enum Out<'a> {
    /// Add a bias (n vectors).
    Bias(&'a [V]),
    /// Add a bias (n vectors), then apply the activation.
    BiasThen(&'a [V], Activation),
    /// As it is.
    Store,
    /// Add to what is there.
    Accumulate,
    /// Times the activation's derivative at `h`, its output or its input (same layout as the product).
    TimesDerivative(&'a [V], Activation),
}

/// `C = f(A B)`: A is (m x k) with element (i, p) at `a[i rs + p cs]`, row p of B starts at `b[p ldb]`,
/// row i of C at `c[i ldc]`; B and C have `n` vectors a row. `m` is a multiple of 8.
#[derive(Clone, Copy)]
pub struct Gemm<'a> {
    /// Rows of A and C.
    pub m: usize,
    /// Columns of A, rows of B.
    pub k: usize,
    /// Vectors in a row of B and C.
    pub n: usize,
    /// Elements of A.
    pub a: &'a [f32],
    /// Distance between rows of A in elements.
    pub rs: usize,
    /// Distance between columns of A in elements.
    pub cs: usize,
    /// Rows of B.
    pub b: &'a [V],
    /// Distance between rows of B in vectors.
    pub ldb: usize,
    /// Distance between rows of C in vectors.
    pub ldc: usize,
    /// What happens before the store.
    pub out: Out<'a>,
}

/// One block of M rows and N vectors, kept in registers.
#[inline(always)]
fn block<const M: usize, const N: usize>(g: &Gemm<'_>, c: &mut [V], i0: usize, j0: usize) {
    let mut acc = [[ZERO; N]; M];
    // SAFETY: `gemm_body` asserted that every index below is inside its slice.
    unsafe {
        let mut a = g.a.as_ptr().add(i0 * g.rs);
        let mut b = g.b.as_ptr().add(j0);
        for p in 0..g.k {
            let mut row = [ZERO; N];
            for j in 0..N {
                row[j] = *b.add(j);
            }
            for i in 0..M {
                let s = V::splat(*a.add(i * g.rs));
                for j in 0..N {
                    acc[i][j] = acc[i][j].fma(s, row[j]);
                }
            }
            if p + 1 < g.k {
                a = a.add(g.cs);
                b = b.add(g.ldb);
            }
        }
        for i in 0..M {
            for j in 0..N {
                let at = (i0 + i) * g.ldc + j0 + j;
                let to = c.as_mut_ptr().add(at);
                let v = acc[i][j];
                *to = match g.out {
                    Out::Bias(b) => v + *b.get_unchecked(j0 + j),
                    Out::BiasThen(b, f) => f.apply(v + *b.get_unchecked(j0 + j)),
                    Out::Store => v,
                    Out::Accumulate => v + *to,
                    Out::TimesDerivative(h, f) => f.times_derivative(v, *h.get_unchecked(at)),
                };
            }
        }
    }
}

#[inline(always)]
fn gemm_body<const WIDE: bool>(g: &Gemm<'_>, c: &mut [V]) {
    if g.m == 0 || g.k == 0 || g.n == 0 {
        return;
    }
    let last_c = (g.m - 1) * g.ldc + g.n;
    assert!(g.m.is_multiple_of(8) && c.len() >= last_c);
    assert!(g.a.len() > (g.m - 1) * g.rs + (g.k - 1) * g.cs && g.b.len() >= (g.k - 1) * g.ldb + g.n);
    match g.out {
        Out::Bias(b) | Out::BiasThen(b, _) => assert!(b.len() >= g.n),
        Out::TimesDerivative(h, _) => assert!(h.len() >= last_c),
        Out::Store | Out::Accumulate => {}
    }
    let mut j = 0;
    while j < g.n {
        let n = match g.n - j {
            _ if !WIDE => 1,
            3 => 3,
            rest => rest.min(2),
        };
        for i in (0..g.m).step_by(if WIDE { 8 } else { 4 }) {
            match (WIDE, n) {
                (false, _) => block::<4, 1>(g, c, i, j),
                (_, 1) => block::<8, 1>(g, c, i, j),
                (_, 2) => block::<8, 2>(g, c, i, j),
                _ => block::<8, 3>(g, c, i, j),
            }
        }
        j += n;
    }
}

/// Defines a function that runs one body compiled for AVX-512, AVX2 with FMA, or the baseline, chosen at run time.
/// `RUSTFLAGS` stay as they are: C++ in the same program must not see wider vectors.
#[macro_export]
macro_rules! multiversion {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($a:ident: $t:ty),* $(,)?) = $body:expr) => {
        $(#[$meta])*
        $vis fn $name($($a: $t),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn v4($($a: $t),*) {
                    ($body)($($a),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn v3($($a: $t),*) {
                    ($body)($($a),*)
                }
                match $crate::net::kernel::isa() {
                    // SAFETY: `isa` found these features on this processor.
                    2 => return unsafe { v4($($a),*) },
                    // SAFETY: as above.
                    1 => return unsafe { v3($($a),*) },
                    _ => {}
                }
            }
            ($body)($($a),*)
        }
    };
}

/// 2: AVX-512, 1: AVX2 with FMA, 0: baseline. The environment variable `NEARL_ISA` may lower it, for tests.
pub fn isa() -> u8 {
    const UNKNOWN: u8 = 255;
    static ISA: AtomicU8 = AtomicU8::new(UNKNOWN);
    match ISA.load(Ordering::Relaxed) {
        UNKNOWN => {
            let asked = std::env::var("NEARL_ISA").ok().and_then(|s| s.parse().ok()).unwrap_or(2u8);
            let found = detect().min(asked);
            ISA.store(found, Ordering::Relaxed);
            found
        }
        found => found,
    }
}

#[cfg(target_arch = "x86_64")]
fn detect() -> u8 {
    let v3 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    let v4 = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512bw");
    u8::from(v3) + u8::from(v3 && v4)
}

#[cfg(not(target_arch = "x86_64"))]
fn detect() -> u8 {
    0
}

multiversion!(fn gemm_wide(g: &Gemm<'_>, c: &mut [V]) = gemm_body::<true>);
multiversion!(fn gemm_narrow(g: &Gemm<'_>, c: &mut [V]) = gemm_body::<false>);

/// See [`Gemm`]. 32 vector registers take blocks of 8 x 32 lanes, 16 take 4 x 16; each element's sum is the same.
pub fn gemm(g: &Gemm<'_>, c: &mut [V]) {
    if isa() == 2 { gemm_wide(g, c) } else { gemm_narrow(g, c) }
}
