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

// -- building (load.cpp) --
nc_model *nc_model_from_urdf_text(const char *xml, int free_flyer);
nc_model *nc_model_from_mjcf_file(const char *path);
void nc_model_free(nc_model *);
int nc_model_nq(const nc_model *);
int nc_model_nv(const nc_model *);
int nc_model_njoints(const nc_model *); // without the universe
// joint 0 is the first after the universe; *type: the letters Pinocchio names the joint with
int nc_model_joint(const nc_model *, int joint, char *name, size_t name_cap, char *type, size_t type_cap,
                   int *idx_q, int *nq, int *idx_v, int *nv);
// lower and upper hold nq numbers, the others nv
int nc_model_limits(const nc_model *, double *lower, double *upper, double *velocity, double *effort,
                    double *damping, double *friction);
double nc_model_mass(const nc_model *);
double nc_model_joint_mass(const nc_model *, int joint);
int nc_model_scale_mass(nc_model *, double factor);
int nc_model_set_gravity(nc_model *, const double gravity[3]);
int nc_model_set_armature(nc_model *, const double *armature);
// moves everything that hangs on the universe; pose: position, then the rotation matrix column by column
int nc_model_place_base(nc_model *, const double pose[12]);
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
int nc_model_nframes(const nc_model *); // with the universe, frame 0
// *body: 1 for a link; *joint: the joint that moves it, -1 for none
int nc_model_frame(const nc_model *, int frame, char *name, size_t name_cap, int *body, int *joint);
int nc_model_joint_parent(const nc_model *, int joint); // -1: the universe
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
