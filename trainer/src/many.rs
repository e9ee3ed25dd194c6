//! Projections of many states at once, on all cores.

use nearl_runtime::constraints::{Limit, LimitError, Model, Projector, Proposal, Settings, Target};

/// States and proposals, row by row.
#[derive(Clone, Debug)]
pub struct Rows {
    /// Measured configurations (n x nq).
    pub q: Vec<f64>,
    /// Measured velocities (n x nv).
    pub v: Vec<f64>,
    /// Proposed configurations (n x nq).
    pub q_proposal: Vec<f64>,
    /// Proposed velocities (n x nv).
    pub v_proposal: Vec<f64>,
}

/// Projectors that are alike, one for each thread.
pub struct Projectors {
    model: Model,
    limits: Vec<Box<dyn Limit>>,
    controllable: Vec<usize>,
    settings: Settings,
    /// The first is for single projections too.
    all: Vec<Projector>,
}

impl Projectors {
    /// One, as [`Projector::new`] builds it; the others are built when they are needed.
    ///
    /// # Errors
    /// [`LimitError`].
    pub fn new(
        model: &Model,
        limits: Vec<Box<dyn Limit>>,
        controllable: Vec<usize>,
        settings: Settings,
    ) -> Result<Projectors, LimitError> {
        let first = Projector::new(model, &limits, &controllable, settings)?;
        let settings = first.settings().clone();
        Ok(Projectors { model: model.clone(), limits, controllable, settings, all: vec![first] })
    }

    /// The first.
    pub fn first(&mut self) -> &mut Projector {
        &mut self.all[0]
    }

    /// All that are there, for what changes them alike.
    pub fn all(&mut self) -> &mut [Projector] {
        &mut self.all
    }

    /// What they were built with.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The limits they were built from.
    pub fn limits(&self) -> &[Box<dyn Limit>] {
        &self.limits
    }

    /// Projects every row as if it were the only one, on `threads` threads, all cores by default.
    ///
    /// # Errors
    /// [`LimitError`] of a further projector.
    pub fn project(&mut self, rows: &Rows, threads: Option<usize>) -> Result<Vec<Target>, LimitError> {
        let mut targets = vec![Target::new(&self.model); rows.len(&self.model)];
        let size = self.share(targets.len(), threads)?;
        let model = &self.model;
        std::thread::scope(|scope| {
            for ((i, share), projector) in targets.chunks_mut(size).enumerate().zip(&mut self.all) {
                scope.spawn(move || rows.project(model, i * size, projector, share));
            }
        });
        Ok(targets)
    }

    /// Vector-Jacobian products: from the derivatives `dq` and `dv` (n x nv each) of a scalar with respect to the targets to those with
    /// respect to the proposals.
    ///
    /// # Errors
    /// [`LimitError`] of a further projector.
    pub fn vjp(
        &mut self,
        rows: &Rows,
        (dq, dv): (&[f64], &[f64]),
        threads: Option<usize>,
    ) -> Result<(Vec<f64>, Vec<f64>), LimitError> {
        let (n, nv) = (rows.len(&self.model), self.model.nv());
        let (mut dq_proposal, mut dv_proposal) = (vec![0.0; n * nv], vec![0.0; n * nv]);
        let size = self.share(n, threads)?;
        let model = &self.model;
        std::thread::scope(|scope| {
            let shares = dq_proposal.chunks_mut(size * nv).zip(dv_proposal.chunks_mut(size * nv));
            for ((k, (dq_share, dv_share)), projector) in shares.enumerate().zip(&mut self.all) {
                scope.spawn(move || {
                    let mut target = [Target::new(model)];
                    for (j, (dq_out, dv_out)) in
                        dq_share.chunks_mut(nv).zip(dv_share.chunks_mut(nv)).enumerate()
                    {
                        let i = k * size + j;
                        rows.project(model, i, projector, &mut target);
                        projector.vjp(&dq[i * nv..][..nv], &dv[i * nv..][..nv], dq_out, dv_out);
                    }
                });
            }
        });
        Ok((dq_proposal, dv_proposal))
    }

    /// Rows for each thread, of `n`; builds as many projectors as there are threads, alike in what is switched on, moved and pushes.
    fn share(&mut self, n: usize, threads: Option<usize>) -> Result<usize, LimitError> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = threads.unwrap_or(cores).clamp(1, n.max(1));
        while self.all.len() < threads {
            let settings = self.settings.clone();
            let mut new = Projector::new(&self.model, &self.limits, &self.controllable, settings)?;
            let first = &self.all[0];
            let off: Vec<String> =
                first.enabled().filter(|(_, on)| !on).map(|(name, _)| name.to_string()).collect();
            off.iter().try_for_each(|name| new.set_enabled(name, false))?;
            new.set_external_forces(first.external_forces())?;
            new.set_moved(first.moved());
            self.all.push(new);
        }
        Ok(n.div_ceil(threads).max(1))
    }
}

impl Rows {
    /// Number of rows.
    fn len(&self, model: &Model) -> usize {
        self.v.len() / model.nv().max(1)
    }

    /// Projects rows from `first` on, each as if it were the only one. What the projector remembers stays.
    fn project(&self, model: &Model, first: usize, projector: &mut Projector, targets: &mut [Target]) {
        let (nq, nv) = (model.nq(), model.nv());
        let mut proposal = Proposal::new(model);
        let memory = projector.memory();
        for (i, target) in (first..).zip(targets) {
            proposal.q.copy_from_slice(&self.q_proposal[i * nq..][..nq]);
            proposal.v.copy_from_slice(&self.v_proposal[i * nv..][..nv]);
            projector.forget();
            projector.project(&self.q[i * nq..][..nq], &self.v[i * nv..][..nv], &proposal, target);
        }
        projector.set_memory(&memory);
    }
}
