//! The border to the C++ shim (`cpp/shim.h`): its raw functions, and the two types that own what it allocates.

use crate::description::{Body, JointDescription, JointKind};
use crate::geometry::Placement;
use std::ffi::{CStr, c_char, c_int};

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
    fn nc_model_new(gravity: *const f64) -> *mut NcModel;
    fn nc_model_free(m: *mut NcModel);
    fn nc_model_nq(m: *const NcModel) -> c_int;
    fn nc_model_nv(m: *const NcModel) -> c_int;
    fn nc_model_add_joint(
        m: *mut NcModel,
        parent: c_int,
        kind: c_int,
        axis: *const f64,
        pose: *const f64,
    ) -> c_int;
    fn nc_model_append_body(
        m: *mut NcModel,
        joint: c_int,
        pose: *const f64,
        mass: f64,
        com: *const f64,
        inertia: *const f64,
    ) -> c_int;
    fn nc_model_add_frame(m: *mut NcModel, joint: c_int, pose: *const f64) -> c_int;
    fn nc_model_mass(m: *const NcModel) -> f64;
    fn nc_model_set_armature(m: *mut NcModel, armature: *const f64) -> c_int;
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
    /// A model without joints.
    pub(crate) fn new(gravity: [f64; 3]) -> Result<RawModel, String> {
        // SAFETY: three numbers.
        let raw = unsafe { nc_model_new(gravity.as_ptr()) };
        if raw.is_null() { Err(last_error()) } else { Ok(RawModel(raw)) }
    }

    /// Adds a joint after the others; its number is the count of those before it.
    pub(crate) fn add_joint(
        &mut self,
        parent: Option<usize>,
        joint: &JointDescription,
        at: &Placement,
    ) -> Result<(), String> {
        let kind = match joint.kind {
            JointKind::Free => 0,
            JointKind::Ball => 1,
            JointKind::Hinge => 2,
            JointKind::Continuous => 3,
            JointKind::Slide => 4,
            JointKind::Planar => 5,
        };
        // SAFETY: exclusive access; three and twelve numbers.
        done(unsafe {
            nc_model_add_joint(self.0, number(parent), kind, joint.axis.as_ptr(), pose(at).as_ptr())
        })
    }

    /// Adds a body's mass to what a joint moves.
    pub(crate) fn append_body(
        &mut self,
        joint: Option<usize>,
        body: &Body,
        at: &Placement,
    ) -> Result<(), String> {
        let (com, inertia) = (body.com.as_ptr(), body.inertia.as_ptr());
        // SAFETY: exclusive access; twelve, three and six numbers.
        done(unsafe {
            nc_model_append_body(self.0, number(joint), pose(at).as_ptr(), body.mass, com, inertia)
        })
    }

    /// Adds a frame after the others; 0 is the world.
    pub(crate) fn add_frame(&mut self, joint: Option<usize>, at: &Placement) -> Result<(), String> {
        // SAFETY: exclusive access; twelve numbers.
        done(unsafe { nc_model_add_frame(self.0, number(joint), pose(at).as_ptr()) })
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

    pub(crate) fn mass(&self) -> f64 {
        // SAFETY: reads the inertias.
        unsafe { nc_model_mass(self.0) }
    }

    pub(crate) fn set_armature(&mut self, armature: &[f64]) {
        assert_eq!(armature.len(), self.nv());
        // SAFETY: exclusive access, nv numbers.
        unsafe { nc_model_set_armature(self.0, armature.as_ptr()) };
    }

    pub(crate) fn neutral(&self) -> Vec<f64> {
        let mut q = vec![0.0; self.nq()];
        // SAFETY: nq numbers.
        unsafe { nc_model_neutral(self.0, q.as_mut_ptr()) };
        q
    }
}

/// The shim's number of a joint; -1 is the world.
fn number(joint: Option<usize>) -> c_int {
    joint.map_or(-1, |joint| joint as c_int)
}

/// Position, then the rotation matrix by rows.
fn pose(at: &Placement) -> [f64; 12] {
    let mut pose = [0.0; 12];
    pose[..3].copy_from_slice(&at.position);
    pose[3..].copy_from_slice(at.rotation.as_flattened());
    pose
}

fn done(code: c_int) -> Result<(), String> {
    if code == 0 { Ok(()) } else { Err(last_error()) }
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
