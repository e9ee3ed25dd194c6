// C functions over Pinocchio. Matrices are column-major, every buffer belongs to the caller.
// Functions returning int: 0 is success, -1 an exception whose text nc_last_error() returns (same thread).
#pragma once
#include <stddef.h>
#ifdef __cplusplus
extern "C" {
#endif
typedef struct nc_model nc_model; // constants: immutable once built, shared between threads
typedef struct nc_data nc_data;   // scratch: one per thread

const char *nc_last_error(void);

// -- building (build.cpp): joints are numbered from 0 as they are added, -1 is the world --
// poses: position, then the rotation matrix row by row
enum { NC_FREE, NC_BALL, NC_HINGE, NC_CONTINUOUS, NC_SLIDE, NC_PLANAR };
nc_model *nc_model_new(const double gravity[3]);
void nc_model_free(nc_model *);
int nc_model_nq(const nc_model *);
int nc_model_nv(const nc_model *);
// depth first; axis has length 1
int nc_model_add_joint(nc_model *, int parent, int kind, const double axis[3], const double pose[12]);
// inertia about com: xx, xy, xz, yy, yz, zz
int nc_model_append_body(nc_model *, int joint, const double pose[12], double mass, const double com[3], const double inertia[6]);
int nc_model_add_frame(nc_model *, int joint, const double pose[12]); // frame 0 is the universe
double nc_model_mass(const nc_model *);
int nc_model_set_armature(nc_model *, const double *armature);
int nc_model_neutral(const nc_model *, double *q);

// -- evaluating (dynamics.cpp): none of these allocates --
nc_data *nc_data_new(const nc_model *);
void nc_data_free(nc_data *);
int nc_rnea(const nc_model *, nc_data *, const double *q, const double *v, const double *a, double *tau);
int nc_mass(const nc_model *, nc_data *, const double *q, double *mass);
int nc_nle(const nc_model *, nc_data *, const double *q, const double *v, double *nle);
// d nle_i / d v_j, nv x nv, row-major
int nc_nle_by_velocity(const nc_model *, nc_data *, const double *q, const double *v, double *by_velocity);
int nc_aba(const nc_model *, nc_data *, const double *q, const double *v, const double *tau, double *a);
int nc_integrate(const nc_model *, nc_data *, const double *q, const double *dq, double *out);
int nc_difference(const nc_model *, nc_data *, const double *q0, const double *q1, double *dq);

// -- frames (kinematics.cpp): none of the functions with data allocates --
// placements, velocities and accelerations of all joints; unless null, jacobian gets the column of each dof (6 x nv, linear first, of
// the point at the world's origin, world axes)
int nc_kinematics(const nc_model *, nc_data *, const double *q, const double *v, const double *a, double *jacobian);
// 24 numbers in world axes: position 3, rotation 3 x 3 by rows, velocity 6, classical acceleration 6 (linear first)
int nc_frame(const nc_model *, nc_data *, int frame, double *out);
// 6 x nv by rows (not columns), linear first, world axes at the frame's origin
int nc_frame_jacobian(const nc_model *, nc_data *, int frame, double *jacobian);
// spoils the placements of nc_kinematics
int nc_kinetic_energy(const nc_model *, nc_data *, const double *q, const double *v, double *energy);
#ifdef __cplusplus
}
#endif
