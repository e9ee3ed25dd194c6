//! Exploration noise of the loop. It follows from the seed and the number of the tick alone, so a log that has the seed has the noise.

use super::Noise;

impl Noise {
    /// Standard normal numbers of tick `tick` of seed `seed`: the same two give the same bits, whatever was drawn before.
    pub fn draw(&mut self, seed: u64, tick: u64) {
        let mut stream = Stream(mix(mix(seed ^ 0x6e65_6172_6c2d_7870) ^ tick));
        let entries = self.proposal.iter_mut().chain(&mut self.action);
        entries.for_each(|entry| *entry = stream.normal());
    }
}

/// SplitMix64 (Steele, Lea & Flood 2014).
struct Stream(u64);

impl Stream {
    /// In (0, 1].
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        ((mix(self.0) >> 11) + 1) as f64 / (1_u64 << 53) as f64
    }

    /// Box and Muller (1958).
    fn normal(&mut self) -> f32 {
        let (radius, turn) = ((-2.0 * self.uniform().ln()).sqrt(), self.uniform());
        (radius * (std::f64::consts::TAU * turn).cos()) as f32
    }
}

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_are_standard_normal_and_depend_on_seed_and_tick_alone() {
        let draw = |seed, tick| {
            let mut noise = Noise { proposal: vec![0.0; 3], action: vec![0.0; 2] };
            noise.draw(seed, tick);
            [noise.proposal, noise.action].concat()
        };
        assert_eq!(draw(1, 2), draw(1, 2));
        assert_ne!(draw(1, 2), draw(2, 1));
        let all: Vec<f64> = (0..20_000).flat_map(|t| draw(7, t)).map(f64::from).collect();
        let moment = |k: i32| all.iter().map(|x| x.powi(k)).sum::<f64>() / all.len() as f64;
        // Four standard errors of 100,000 draws.
        assert!(moment(1).abs() < 0.013 && (moment(2) - 1.0).abs() < 0.018, "{} {}", moment(1), moment(2));
        assert!((moment(4) - 3.0).abs() < 0.13, "{}", moment(4));
        // The tick after and the entry beside are other draws.
        let product =
            |step: usize| all.iter().zip(&all[step..]).map(|(a, b)| a * b).sum::<f64>() / all.len() as f64;
        assert!(product(1).abs() < 0.013 && product(5).abs() < 0.013);
    }
}
