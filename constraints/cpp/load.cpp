// Parsers, names, limits, and the corrections that MJCF needs.
#include "common.hpp"
#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/algorithm/model.hpp>
#include <pinocchio/parsers/mjcf.hpp>
#include <pinocchio/parsers/urdf.hpp>
#include <cstdio>
#include <memory>

thread_local std::string nc_error;

extern "C" {
const char *nc_last_error(void) { return nc_error.c_str(); }

nc_model *nc_model_from_urdf_text(const char *xml, int free_flyer) {
  nc_model *out = nullptr;
  guard([&] {
    auto m = std::make_unique<nc_model>();
    if (free_flyer)
      pin::urdf::buildModelFromXML(std::string(xml), pin::JointModelFreeFlyer(), m->model);
    else
      pin::urdf::buildModelFromXML(std::string(xml), m->model);
    out = m.release();
  });
  return out;
}

nc_model *nc_model_from_mjcf_file(const char *path) {
  nc_model *out = nullptr;
  guard([&] {
    auto m = std::make_unique<nc_model>();
    pin::mjcf::buildModel(std::string(path), m->model);
    out = m.release();
  });
  return out;
}

void nc_model_free(nc_model *m) { delete m; }
int nc_model_nq(const nc_model *m) { return m->model.nq; }
int nc_model_nv(const nc_model *m) { return m->model.nv; }
int nc_model_njoints(const nc_model *m) { return m->model.njoints - 1; }

int nc_model_joint(const nc_model *m, int joint, char *name, size_t name_cap, char *type, size_t type_cap,
                   int *idx_q, int *nq, int *idx_v, int *nv) {
  return guard([&] {
    const size_t j = joint + 1;
    std::snprintf(name, name_cap, "%s", m->model.names.at(j).c_str());
    std::snprintf(type, type_cap, "%s", m->model.joints.at(j).shortname().c_str());
    *idx_q = m->model.idx_qs[j];
    *nq = m->model.nqs[j];
    *idx_v = m->model.idx_vs[j];
    *nv = m->model.nvs[j];
  });
}

int nc_model_limits(const nc_model *m, double *lower, double *upper, double *velocity, double *effort,
                    double *damping, double *friction) {
  return guard([&] {
    const auto &x = m->model;
    VectorMap(lower, x.nq) = x.lowerPositionLimit;
    VectorMap(upper, x.nq) = x.upperPositionLimit;
    VectorMap(velocity, x.nv) = x.upperVelocityLimit;
    VectorMap(effort, x.nv) = x.upperEffortLimit;
    VectorMap(damping, x.nv) = x.damping;
    VectorMap(friction, x.nv) = x.upperDryFrictionLimit;
  });
}

double nc_model_mass(const nc_model *m) {
  double sum = 0;
  for (size_t j = 1; j < m->model.inertias.size(); j++) sum += m->model.inertias[j].mass();
  return sum;
}

double nc_model_joint_mass(const nc_model *m, int joint) { return m->model.inertias.at(joint + 1).mass(); }

int nc_model_scale_mass(nc_model *m, double factor) {
  return guard([&] {
    for (size_t j = 1; j < m->model.inertias.size(); j++) {
      auto &y = m->model.inertias[j];
      y = pin::Inertia(y.mass() * factor, y.lever(), pin::Symmetric3(Eigen::Matrix3d(y.inertia().matrix() * factor)));
    }
  });
}

int nc_model_set_gravity(nc_model *m, const double gravity[3]) {
  return guard([&] { m->model.gravity.linear(Eigen::Vector3d(gravity[0], gravity[1], gravity[2])); });
}

int nc_model_place_base(nc_model *m, const double *pose) {
  return guard([&] {
    const pin::SE3 base(Eigen::Map<const Eigen::Matrix3d>(pose + 3), Eigen::Map<const Eigen::Vector3d>(pose));
    for (pin::JointIndex j = 1; j < pin::JointIndex(m->model.njoints); ++j)
      if (m->model.parents[j] == 0)
        m->model.jointPlacements[j] = base * m->model.jointPlacements[j];
    for (pin::FrameIndex f = 1; f < pin::FrameIndex(m->model.nframes); ++f) // 0 is the universe
      if (m->model.frames[f].parentJoint == 0)
        m->model.frames[f].placement = base * m->model.frames[f].placement;
  });
}

int nc_model_set_armature(nc_model *m, const double *armature) {
  return guard([&] { m->model.armature = input(armature, m->model.nv); });
}

int nc_model_neutral(const nc_model *m, double *q) {
  return guard([&] { VectorMap(q, m->model.nq) = pin::neutral(m->model); });
}
}
