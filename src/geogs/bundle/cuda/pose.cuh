// Rigid motions in double precision: the upper three rows R | t of a 4 x 4 matrix, row by row.
#pragma once

__device__ __forceinline__ void multiply_rotations(
    const double* a, int row, int column, const double* b, double* out) {
  // out (3 x 3) = a (3 x 3 with the given strides) b (of stride 4, transposed: b_kc = b[4 c + k]).
  for (int r = 0; r < 3; r++)
    for (int c = 0; c < 3; c++) {
      double s = 0.0;
      for (int k = 0; k < 3; k++) s += a[row * r + column * k] * b[4 * c + k];
      out[3 * r + c] = s;
    }
}

// T_ji = T_j T_i^-1.
__device__ __forceinline__ void relative_motion(const double* T_j, const double* T_i, double* T_ji) {
  double R[9];
  multiply_rotations(T_j, 4, 1, T_i, R);
  for (int r = 0; r < 3; r++) {
    double t = T_j[4 * r + 3];
    for (int c = 0; c < 3; c++) {
      T_ji[4 * r + c] = R[3 * r + c];
      t -= R[3 * r + c] * T_i[4 * c + 3];
    }
    T_ji[4 * r + 3] = t;
  }
}

__device__ __forceinline__ void inverse_motion(const double* T, double* out) {
  for (int r = 0; r < 3; r++) {
    double t = 0.0;
    for (int c = 0; c < 3; c++) {
      out[4 * r + c] = T[4 * c + r];
      t -= T[4 * c + r] * T[4 * c + 3];
    }
    out[4 * r + 3] = t;
  }
}

// Entry (r, c) of the adjoint [R, [t]x R; 0, R] of a motion.
__device__ __forceinline__ double adjoint_entry(const double* T, int r, int c) {
  if (r >= 3 && c < 3) return 0.0;
  if (r >= 3 || c < 3) return T[4 * (r % 3) + c % 3];
  int k = (r + 1) % 3, l = (r + 2) % 3;
  return T[4 * k + 3] * T[4 * l + c - 3] - T[4 * l + 3] * T[4 * k + c - 3];
}

// Component k of xi_j - Ad(T_ji) xi_i.
__device__ __forceinline__ double relative_step(
    const double* T_ji, const double* xi_j, const double* xi_i, int k) {
  double s = xi_j[k];
  for (int c = 0; c < 6; c++) s -= adjoint_entry(T_ji, k, c) * xi_i[c];
  return s;
}

// v + a phi x v + b phi x (phi x v).
__device__ __forceinline__ void turn(const double* phi, double a, double b, double* v) {
  double x = phi[1] * v[2] - phi[2] * v[1], y = phi[2] * v[0] - phi[0] * v[2];
  double z = phi[0] * v[1] - phi[1] * v[0];
  v[0] += a * x + b * (phi[1] * z - phi[2] * y);
  v[1] += a * y + b * (phi[2] * x - phi[0] * z);
  v[2] += a * z + b * (phi[0] * y - phi[1] * x);
}

// Makes the rotation orthonormal by way of its quaternion.
__device__ __forceinline__ void orthonormalise(double* T) {
  double d[4] = {1 + T[0] + T[5] + T[10], 1 + T[0] - T[5] - T[10],
                 1 - T[0] + T[5] - T[10], 1 - T[0] - T[5] + T[10]};
  double x = T[9] - T[6], y = T[2] - T[8], z = T[4] - T[1];
  double xy = T[1] + T[4], xz = T[2] + T[8], yz = T[6] + T[9], q[4];
  if (d[0] >= d[1] && d[0] >= d[2] && d[0] >= d[3]) {
    q[0] = d[0]; q[1] = x; q[2] = y; q[3] = z;
  } else if (d[1] >= d[2] && d[1] >= d[3]) {
    q[0] = x; q[1] = d[1]; q[2] = xy; q[3] = xz;
  } else if (d[2] >= d[3]) {
    q[0] = y; q[1] = xy; q[2] = d[2]; q[3] = yz;
  } else {
    q[0] = z; q[1] = xz; q[2] = yz; q[3] = d[3];
  }
  double s = 2 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  T[0] = 1 - s * (q[2] * q[2] + q[3] * q[3]);
  T[1] = s * (q[1] * q[2] - q[0] * q[3]);
  T[2] = s * (q[1] * q[3] + q[0] * q[2]);
  T[4] = s * (q[1] * q[2] + q[0] * q[3]);
  T[5] = 1 - s * (q[1] * q[1] + q[3] * q[3]);
  T[6] = s * (q[2] * q[3] - q[0] * q[1]);
  T[8] = s * (q[1] * q[3] - q[0] * q[2]);
  T[9] = s * (q[2] * q[3] + q[0] * q[1]);
  T[10] = 1 - s * (q[1] * q[1] + q[2] * q[2]);
}

// T <- Exp(xi) T, the rotation made orthonormal again.
__device__ __forceinline__ void move_pose(const double* xi, double* T) {
  const double* phi = xi + 3;
  double t2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2], a, b, c;
  if (t2 < 1e-4) {
    a = 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42));
    b = 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56));
    c = 1. / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72));
  } else {
    double t = sqrt(t2), s = sin(t);
    a = s / t;
    b = (1 - cos(t)) / t2;
    c = (t - s) / (t2 * t);
  }
  double tau[3] = {xi[0], xi[1], xi[2]};
  turn(phi, b, c, tau);
  for (int k = 0; k < 4; k++) {
    double v[3] = {T[k], T[4 + k], T[8 + k]};
    turn(phi, a, b, v);
    for (int r = 0; r < 3; r++) T[4 * r + k] = v[r] + (k == 3 ? tau[r] : 0.0);
  }
  orthonormalise(T);
}
