// Building a model joint by joint.
#include "common.hpp"
#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/algorithm/model.hpp>
#include <memory>
#include <string>

thread_local std::string nc_error;

// pose: position, then the rotation matrix row by row
static pin::SE3 placement(const double *pose) {
  return pin::SE3(Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(pose + 3), Eigen::Map<const Eigen::Vector3d>(pose));
}

static pin::JointIndex add(pin::Model &m, pin::JointIndex parent, const pin::JointModel &joint, const double *pose) {
  return m.addJoint(parent, joint, placement(pose), "j" + std::to_string(m.njoints));
}

// Joints about or along a coordinate axis have cheaper types of their own.
template <class X, class Y, class Z, class Any>
static pin::JointModel along(const double *axis) {
  const Eigen::Vector3d a(axis[0], axis[1], axis[2]);
  if (a == Eigen::Vector3d::UnitX()) return X();
  if (a == Eigen::Vector3d::UnitY()) return Y();
  if (a == Eigen::Vector3d::UnitZ()) return Z();
  return Any(a.normalized());
}

static pin::JointModel joint(int kind, const double *axis) {
  switch (kind) {
  case NC_FREE: return pin::JointModelFreeFlyer();
  case NC_BALL: return pin::JointModelSpherical();
  case NC_PLANAR: return pin::JointModelPlanar();
  case NC_HINGE:
    return along<pin::JointModelRX, pin::JointModelRY, pin::JointModelRZ, pin::JointModelRevoluteUnaligned>(axis);
  case NC_CONTINUOUS:
    return along<pin::JointModelRUBX, pin::JointModelRUBY, pin::JointModelRUBZ, pin::JointModelRevoluteUnboundedUnaligned>(axis);
  case NC_SLIDE:
    return along<pin::JointModelPX, pin::JointModelPY, pin::JointModelPZ, pin::JointModelPrismaticUnaligned>(axis);
  }
  throw std::invalid_argument("a joint of a kind that is not known");
}

extern "C" {
const char *nc_last_error(void) { return nc_error.c_str(); }

nc_model *nc_model_new(const double gravity[3]) {
  nc_model *out = nullptr;
  guard([&] {
    auto m = std::make_unique<nc_model>();
    m->model.gravity.linear(Eigen::Vector3d(gravity[0], gravity[1], gravity[2]));
    out = m.release();
  });
  return out;
}

void nc_model_free(nc_model *m) { delete m; }
int nc_model_nq(const nc_model *m) { return m->model.nq; }
int nc_model_nv(const nc_model *m) { return m->model.nv; }

int nc_model_add_joint(nc_model *m, int parent, int kind, const double axis[3], const double pose[12]) {
  return guard([&] { add(m->model, parent + 1, joint(kind, axis), pose); });
}

int nc_model_append_body(nc_model *m, int joint, const double pose[12], double mass, const double com[3], const double inertia[6]) {
  return guard([&] {
    Eigen::Matrix3d about_com;
    about_com << inertia[0], inertia[1], inertia[2], inertia[1], inertia[3], inertia[4], inertia[2], inertia[4], inertia[5];
    const pin::Inertia y(mass, Eigen::Vector3d(com[0], com[1], com[2]), pin::Symmetric3(about_com));
    m->model.appendBodyToJoint(joint + 1, y, placement(pose));
  });
}

int nc_model_add_frame(nc_model *m, int joint, const double pose[12]) {
  return guard([&] {
    const std::string name = "f" + std::to_string(m->model.nframes);
    m->model.addFrame(pin::Frame(name, joint + 1, 0, placement(pose), pin::OP_FRAME));
  });
}

double nc_model_mass(const nc_model *m) {
  double sum = 0;
  for (size_t j = 1; j < m->model.inertias.size(); j++) sum += m->model.inertias[j].mass();
  return sum;
}

int nc_model_set_armature(nc_model *m, const double *armature) {
  return guard([&] {
    m->model.armature = input(armature, m->model.nv);
    m->with_armature.clear();
    for (const auto &joint : m->model.joints) {
      if (joint.nv() == 6 && input(armature + joint.idx_v(), 3).any()) m->with_armature.push_back(joint.idx_v());
    }
  });
}

int nc_model_neutral(const nc_model *m, double *q) {
  return guard([&] { VectorMap(q, m->model.nq) = pin::neutral(m->model); });
}
}
