//! The border to the C++ shim (`cpp/shim.h`): raw functions and two owners.

use nalgebra::Isometry3;
use std::ffi::{CStr, CString, c_char, c_int};

#[repr(C)]
pub(crate) struct NcModel {
    _opaque: [u8; 0],
}
#[repr(C)]
pub(crate) struct NcData {
    _opaque: [u8; 0],
}

unsafe extern "C" {
    fn nc_last_error() -> *const c_char;
    fn nc_model_from_urdf_text(xml: *const c_char, free_flyer: c_int) -> *mut NcModel;
    fn nc_model_from_mjcf_file(path: *const c_char) -> *mut NcModel;
    fn nc_model_free(m: *mut NcModel);
    fn nc_model_nq(m: *const NcModel) -> c_int;
    fn nc_model_nv(m: *const NcModel) -> c_int;
    fn nc_model_njoints(m: *const NcModel) -> c_int;
    fn nc_model_joint(
        m: *const NcModel,
        joint: c_int,
        name: *mut c_char,
        name_cap: usize,
        kind: *mut c_char,
        kind_cap: usize,
        idx_q: *mut c_int,
        nq: *mut c_int,
        idx_v: *mut c_int,
        nv: *mut c_int,
    ) -> c_int;
    fn nc_model_limits(
        m: *const NcModel,
        lower: *mut f64,
        upper: *mut f64,
        velocity: *mut f64,
        effort: *mut f64,
        damping: *mut f64,
        friction: *mut f64,
    ) -> c_int;
    fn nc_model_mass(m: *const NcModel) -> f64;
    fn nc_model_joint_mass(m: *const NcModel, joint: c_int) -> f64;
    fn nc_model_scale_mass(m: *mut NcModel, factor: f64) -> c_int;
    fn nc_model_set_gravity(m: *mut NcModel, gravity: *const f64) -> c_int;
    fn nc_model_set_armature(m: *mut NcModel, armature: *const f64) -> c_int;
    fn nc_model_place_base(m: *mut NcModel, pose: *const f64) -> c_int;
    fn nc_model_neutral(m: *const NcModel, q: *mut f64) -> c_int;
    fn nc_data_new(m: *const NcModel) -> *mut NcData;
    fn nc_data_free(d: *mut NcData);
    pub(crate) fn nc_rnea(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        a: *const f64,
        tau: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_mass(m: *const NcModel, d: *mut NcData, q: *const f64, mass: *mut f64) -> c_int;
    pub(crate) fn nc_nle(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        nle: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_nle_by_velocity(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        by_velocity: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_aba(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        tau: *const f64,
        a: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_integrate(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        dq: *const f64,
        out: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_difference(
        m: *const NcModel,
        d: *mut NcData,
        q0: *const f64,
        q1: *const f64,
        dq: *mut f64,
    ) -> c_int;
    fn nc_model_nframes(m: *const NcModel) -> c_int;
    fn nc_model_frame(
        m: *const NcModel,
        frame: c_int,
        name: *mut c_char,
        name_cap: usize,
        body: *mut c_int,
        joint: *mut c_int,
    ) -> c_int;
    fn nc_model_joint_parent(m: *const NcModel, joint: c_int) -> c_int;
    pub(crate) fn nc_kinematics(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        a: *const f64,
        jacobian: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_frame(m: *const NcModel, d: *mut NcData, frame: c_int, out: *mut f64) -> c_int;
    pub(crate) fn nc_frame_jacobian(
        m: *const NcModel,
        d: *mut NcData,
        frame: c_int,
        jacobian: *mut f64,
    ) -> c_int;
    pub(crate) fn nc_kinetic_energy(
        m: *const NcModel,
        d: *mut NcData,
        q: *const f64,
        v: *const f64,
        energy: *mut f64,
    ) -> c_int;
}

/// Text of the last exception of this thread.
pub(crate) fn last_error() -> String {
    // SAFETY: the shim returns the text of a thread-local std::string, valid until the next call of this thread.
    unsafe { CStr::from_ptr(nc_last_error()) }.to_string_lossy().trim().to_string()
}

/// One joint as Pinocchio sees it; several MJCF joints of one body are one composite here.
pub(crate) struct RawJoint {
    pub(crate) name: String,
    pub(crate) kind: String,
    pub(crate) idx_q: usize,
    pub(crate) nq: usize,
    pub(crate) idx_v: usize,
    pub(crate) nv: usize,
    pub(crate) mass: f64,
    /// The joint before it in the chain; `None` for the first.
    pub(crate) parent: Option<usize>,
}

/// One frame: a link, a joint, or what an MJCF calls a site.
pub(crate) struct RawFrame {
    pub(crate) name: String,
    /// True for a link.
    pub(crate) body: bool,
    /// The [`RawJoint`] that moves it; `None` for what is fixed to the world.
    pub(crate) joint: Option<usize>,
}

/// Numbers per configuration entry (`lower`, `upper`) and per dof (the others).
pub(crate) struct RawLimits {
    pub(crate) lower: Vec<f64>,
    pub(crate) upper: Vec<f64>,
    pub(crate) velocity: Vec<f64>,
    pub(crate) effort: Vec<f64>,
    pub(crate) damping: Vec<f64>,
    pub(crate) friction: Vec<f64>,
}

/// Owner of a `pinocchio::Model`.
pub(crate) struct RawModel(*mut NcModel);

// SAFETY: after building (through &mut) the C++ model is never written again.
unsafe impl Send for RawModel {}
// SAFETY: every function taking `*const NcModel` only reads it.
unsafe impl Sync for RawModel {}

impl Drop for RawModel {
    fn drop(&mut self) {
        // SAFETY: the pointer came from the shim and is freed once.
        unsafe { nc_model_free(self.0) }
    }
}

impl RawModel {
    pub(crate) fn from_urdf_text(xml: &CString, free_flyer: bool) -> Result<RawModel, String> {
        // SAFETY: a NUL-terminated text, copied by the shim.
        RawModel::own(unsafe { nc_model_from_urdf_text(xml.as_ptr(), c_int::from(free_flyer)) })
    }

    pub(crate) fn from_mjcf_file(path: &CString) -> Result<RawModel, String> {
        // SAFETY: a NUL-terminated path, copied by the shim.
        RawModel::own(unsafe { nc_model_from_mjcf_file(path.as_ptr()) })
    }

    fn own(raw: *mut NcModel) -> Result<RawModel, String> {
        if raw.is_null() { Err(last_error()) } else { Ok(RawModel(raw)) }
    }

    pub(crate) fn as_ptr(&self) -> *const NcModel {
        self.0
    }

    pub(crate) fn nq(&self) -> usize {
        // SAFETY: reads one field.
        unsafe { nc_model_nq(self.0) as usize }
    }

    pub(crate) fn nv(&self) -> usize {
        // SAFETY: reads one field.
        unsafe { nc_model_nv(self.0) as usize }
    }

    pub(crate) fn joints(&self) -> Vec<RawJoint> {
        // SAFETY: reads one field.
        let n = unsafe { nc_model_njoints(self.0) };
        (0..n).map(|j| self.joint(j)).collect()
    }

    fn joint(&self, j: c_int) -> RawJoint {
        let (mut name, mut kind, mut at) = ([0 as c_char; 256], [0 as c_char; 64], [0 as c_int; 4]);
        let [idx_q, nq, idx_v, nv] = &mut at;
        // SAFETY: buffers outlive the call and their sizes are passed; the shim terminates both texts.
        let (name, kind) = unsafe {
            nc_model_joint(
                self.0,
                j,
                name.as_mut_ptr(),
                name.len(),
                kind.as_mut_ptr(),
                kind.len(),
                idx_q,
                nq,
                idx_v,
                nv,
            );
            (CStr::from_ptr(name.as_ptr()), CStr::from_ptr(kind.as_ptr()))
        };
        let (name, kind) = (name.to_string_lossy().into_owned(), kind.to_string_lossy().into_owned());
        let [idx_q, nq, idx_v, nv] = at.map(|x| x as usize);
        // SAFETY: reads one inertia and one index.
        let (mass, parent) = unsafe { (nc_model_joint_mass(self.0, j), nc_model_joint_parent(self.0, j)) };
        RawJoint { name, kind, idx_q, nq, idx_v, nv, mass, parent: usize::try_from(parent).ok() }
    }

    pub(crate) fn frames(&self) -> Vec<RawFrame> {
        // SAFETY: reads one field.
        let n = unsafe { nc_model_nframes(self.0) };
        (0..n).map(|f| self.frame(f)).collect()
    }

    fn frame(&self, f: c_int) -> RawFrame {
        let (mut name, mut body, mut joint) = ([0 as c_char; 256], 0, -1);
        // SAFETY: the buffer outlives the call and its size is passed; the shim terminates the text.
        let name = unsafe {
            nc_model_frame(self.0, f, name.as_mut_ptr(), name.len(), &raw mut body, &raw mut joint);
            CStr::from_ptr(name.as_ptr()).to_string_lossy().into_owned()
        };
        RawFrame { name, body: body != 0, joint: usize::try_from(joint).ok() }
    }

    pub(crate) fn limits(&self) -> RawLimits {
        let (q, v) = (vec![0.0; self.nq()], vec![0.0; self.nv()]);
        let mut l = RawLimits {
            lower: q.clone(),
            upper: q,
            velocity: v.clone(),
            effort: v.clone(),
            damping: v.clone(),
            friction: v,
        };
        // SAFETY: six buffers of nq, nq, nv, nv, nv, nv numbers.
        unsafe {
            nc_model_limits(
                self.0,
                l.lower.as_mut_ptr(),
                l.upper.as_mut_ptr(),
                l.velocity.as_mut_ptr(),
                l.effort.as_mut_ptr(),
                l.damping.as_mut_ptr(),
                l.friction.as_mut_ptr(),
            );
        }
        l
    }

    pub(crate) fn mass(&self) -> f64 {
        // SAFETY: reads the inertias.
        unsafe { nc_model_mass(self.0) }
    }

    pub(crate) fn scale_mass(&mut self, factor: f64) {
        // SAFETY: exclusive access.
        unsafe { nc_model_scale_mass(self.0, factor) };
    }

    pub(crate) fn set_gravity(&mut self, gravity: [f64; 3]) {
        // SAFETY: exclusive access, three numbers.
        unsafe { nc_model_set_gravity(self.0, gravity.as_ptr()) };
    }

    pub(crate) fn set_armature(&mut self, armature: &[f64]) {
        assert_eq!(armature.len(), self.nv());
        // SAFETY: exclusive access, nv numbers.
        unsafe { nc_model_set_armature(self.0, armature.as_ptr()) };
    }

    pub(crate) fn place_base(&mut self, base: &Isometry3<f64>) {
        let rotation = base.rotation.to_rotation_matrix();
        let mut pose = [0.0; 12];
        pose[..3].copy_from_slice(base.translation.vector.as_slice());
        pose[3..].copy_from_slice(rotation.matrix().as_slice());
        // SAFETY: exclusive access, twelve numbers.
        unsafe { nc_model_place_base(self.0, pose.as_ptr()) };
    }

    pub(crate) fn neutral(&self) -> Vec<f64> {
        let mut q = vec![0.0; self.nq()];
        // SAFETY: nq numbers.
        unsafe { nc_model_neutral(self.0, q.as_mut_ptr()) };
        q
    }
}

/// Owner of a `pinocchio::Data`: scratch of one thread.
pub(crate) struct RawData(*mut NcData);

// SAFETY: plain heap memory without thread affinity; used through &mut only.
unsafe impl Send for RawData {}

impl Drop for RawData {
    fn drop(&mut self) {
        // SAFETY: the pointer came from the shim and is freed once.
        unsafe { nc_data_free(self.0) }
    }
}

impl RawData {
    pub(crate) fn new(model: &RawModel) -> RawData {
        // SAFETY: a valid model; null means out of memory, which Rust treats as fatal as well.
        let raw = unsafe { nc_data_new(model.0) };
        assert!(!raw.is_null(), "Pinocchio could not allocate its scratch: {}", last_error());
        RawData(raw)
    }

    pub(crate) fn as_ptr(&mut self) -> *mut NcData {
        self.0
    }
}
