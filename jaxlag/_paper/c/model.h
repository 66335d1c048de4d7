/* A mechanical system: what `sizes.h` and `model.c`, which are written for each, say of it.

       A (qddot, multipliers) = b,   g(t, q) = 0,   psi(t, q, qdot) = 0

   Its numbers stand in one array in this order, and the value reference of a variable is its place:
   t; q; qdot; further states; parameters and inputs; qddot; multipliers; rates of the further states; what follows from these. */
#ifndef MODEL_H
#define MODEL_H
#include "sizes.h" /* Q_SIZE, S_SIZE, P_SIZE, G_SIZE, PSI_SIZE, Z_SIZE, D_SIZE: of q, further states, parameters, g, psi, A, what follows */

enum {
    Q_AT = 1,
    V_AT = Q_AT + Q_SIZE,
    S_AT = V_AT + Q_SIZE,
    P_AT = S_AT + S_SIZE,
    Z_AT = P_AT + P_SIZE,
    R_AT = Z_AT + Z_SIZE,
    D_AT = R_AT + S_SIZE,
    SIZE = D_AT + D_SIZE,
    X_SIZE = 2 * Q_SIZE + S_SIZE /* of the state */
};

/* `model.c` also holds TOKEN, the NAMES of all variables, their START up to Z_AT, and of parameters whether each IS_INPUT. */

/* A by rows, b, rates of the further states */
static void equations(const double *x, double *y);
static void equations_tangent(const double *x, const double *dx, double *y);
/* g, psi, and the size of the terms of each row of g */
static void constraints(const double *x, double *y);
static void constraints_tangent(const double *x, const double *dx, double *y); /* of g and psi alone */
/* what follows from the others */
static void outputs(const double *x, double *y);
static void outputs_tangent(const double *x, const double *dx, double *y);

#endif
