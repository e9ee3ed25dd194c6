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
  });
}

int nc_nle_by_velocity(const nc_model *m, nc_data *d, const double *q, const double *v, double *by_velocity) {
  const auto &x = m->model;
  return guard([&] {
    d->dq.setZero();
    pin::computeRNEADerivatives(x, d->data, input(q, x.nq), input(v, x.nv), Input(d->dq));
    MatrixMap(by_velocity, x.nv, x.nv) = d->data.dtau_dv.transpose();
  });
}

int nc_aba(const nc_model *m, nc_data *d, const double *q, const double *v, const double *tau, double *a) {
  const auto &x = m->model;
  return guard([&] {
    VectorMap(a, x.nv) = pin::aba(x, d->data, input(q, x.nq), input(v, x.nv), input(tau, x.nv), pin::Convention::WORLD);
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
