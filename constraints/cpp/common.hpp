#pragma once
#include "shim.h"
#include <pinocchio/multibody.hpp>
#include <exception>
#include <string>
#include <vector>

#if defined(__AVX__) || EIGEN_DEFAULT_ALIGN_BYTES != 16 || !_GLIBCXX_USE_CXX11_ABI
#error "the wheel is plain SSE2 with 16-byte Eigen alignment and the C++11 ABI: take -march and -mavx out of CXXFLAGS"
#endif
#ifndef PINOCCHIO_ENABLE_TEMPLATE_INSTANTIATION
#error "the compile definitions must come from the wheel's pinocchioTargets.cmake"
#endif

namespace pin = pinocchio;
using Vector = Eigen::VectorXd;
using VectorMap = Eigen::Map<Vector>;
using MatrixMap = Eigen::Map<Eigen::MatrixXd>;

// The wheel instantiates its algorithms for exactly this type, and it copies nothing; with a bare Map the compiler
// instantiates them here again (50 s each).
using Input = Eigen::Ref<const Vector>;
static inline Input input(const double *p, Eigen::Index n) { return Input(Eigen::Map<const Vector>(p, n)); }

struct nc_model {
  pin::Model model;
  std::vector<int> with_armature; // idx_v of the free joints with an armature

  // MuJoCo's armature of a free joint acts on the acceleration of its origin in the world, Pinocchio's on the change of the velocity's components in the
  // moving body; they differ by w x v. Adds `sign` times the force of that to `force`.
  void add_turning(const double *v, double sign, double *force) const {
    using Three = Eigen::Map<const Eigen::Vector3d>;
    for (const int i : with_armature) {
      const Eigen::Vector3d turned = Three(v + i + 3).cross(Three(v + i));
      for (int k = 0; k < 3; k++) force[i + k] += sign * model.armature[i + k] * turned[k];
    }
  }
};

struct nc_data {
  pin::Data data;
  Vector q0, q1, dq; // integrate and difference are instantiated for plain vectors only
  pin::Data::Matrix6x jacobian;
  explicit nc_data(const pin::Model &m) : data(m), q0(m.nq), q1(m.nq), dq(m.nv), jacobian(6, m.nv) {}
};

extern thread_local std::string nc_error;

// No exception may cross into Rust.
template <class F> static int guard(F &&f) noexcept {
  try {
    f();
    return 0;
  } catch (const std::exception &e) {
    nc_error = e.what();
  } catch (...) {
    nc_error = "unknown C++ exception";
  }
  return -1;
}
