// Dynamics: nothing here allocates.
#include "common.hpp"
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/joint-configuration.hpp>
#include <pinocchio/algorithm/rnea-derivatives.hpp>
#include <pinocchio/algorithm/rnea.hpp>

extern "C" {
nc_data *nc_data_new(const nc_model *m) {
  nc_data *out = nullptr;
  guard([&] { out = new nc_data(m->model); });
  return out;
}

void nc_data_free(nc_data *d) { delete d; }

int nc_rnea(const nc_model *m, nc_data *d, const double *q, const double *v, const double *a, double *tau) {
  const auto &x = m->model;
  return guard([&] {
    VectorMap(tau, x.nv) = pin::rnea(x, d->data, input(q, x.nq), input(v, x.nv), input(a, x.nv));
    m->add_turning(v, 1.0, tau);
  });
}

int nc_mass(const nc_model *m, nc_data *d, const double *q, double *mass) {
  const auto &x = m->model;
  return guard([&] {
    pin::crba(x, d->data, input(q, x.nq), pin::Convention::WORLD);
    MatrixMap out(mass, x.nv, x.nv);
    out.triangularView<Eigen::Upper>() = d->data.M; // CRBA fills the upper triangle only
    out.triangularView<Eigen::StrictlyLower>() = d->data.M.transpose();
  });
}

int nc_nle(const nc_model *m, nc_data *d, const double *q, const double *v, double *nle) {
  const auto &x = m->model;
  return guard([&] {
    VectorMap(nle, x.nv) = pin::nonLinearEffects(x, d->data, input(q, x.nq), input(v, x.nv));
    m->add_turning(v, 1.0, nle);
  });
}

int nc_nle_by_velocity(const nc_model *m, nc_data *d, const double *q, const double *v, double *by_velocity) {
  const auto &x = m->model;
  return guard([&] {
    d->dq.setZero();
    pin::computeRNEADerivatives(x, d->data, input(q, x.nq), input(v, x.nv), Input(d->dq));
    MatrixMap out(by_velocity, x.nv, x.nv); // its columns are the rows
    out = d->data.dtau_dv.transpose();
    for (const int i : m->with_armature) {
      const auto v3 = [v, i](int k) { return v[i + k % 3]; };
      const auto w3 = [v, i](int k) { return v[i + 3 + k % 3]; };
      for (int k = 0; k < 3; k++) { // row k of w x v: w[k+1] v[k+2] - w[k+2] v[k+1]
        const double armature = x.armature[i + k];
        out(i + (k + 2) % 3, i + k) += armature * w3(k + 1);
        out(i + (k + 1) % 3, i + k) -= armature * w3(k + 2);
        out(i + 3 + (k + 1) % 3, i + k) += armature * v3(k + 2);
        out(i + 3 + (k + 2) % 3, i + k) -= armature * v3(k + 1);
      }
    }
  });
}

int nc_aba(const nc_model *m, nc_data *d, const double *q, const double *v, const double *tau, double *a) {
  const auto &x = m->model;
  return guard([&] {
    if (m->with_armature.empty()) {
      VectorMap(a, x.nv) = pin::aba(x, d->data, input(q, x.nq), input(v, x.nv), input(tau, x.nv), pin::Convention::WORLD);
      return;
    }
    d->dq = input(tau, x.nv);
    m->add_turning(v, -1.0, d->dq.data());
    VectorMap(a, x.nv) = pin::aba(x, d->data, input(q, x.nq), input(v, x.nv), Input(d->dq), pin::Convention::WORLD);
  });
}

int nc_integrate(const nc_model *m, nc_data *d, const double *q, const double *dq, double *out) {
  const auto &x = m->model;
  return guard([&] {
    d->q0 = input(q, x.nq);
    d->dq = input(dq, x.nv);
    pin::integrate(x, d->q0, d->dq, d->q1);
    VectorMap(out, x.nq) = d->q1;
  });
}

int nc_difference(const nc_model *m, nc_data *d, const double *q0, const double *q1, double *dq) {
  const auto &x = m->model;
  return guard([&] {
    d->q0 = input(q0, x.nq);
    d->q1 = input(q1, x.nq);
    pin::difference(x, d->q0, d->q1, d->dq);
    VectorMap(dq, x.nv) = d->dq;
  });
}
}
