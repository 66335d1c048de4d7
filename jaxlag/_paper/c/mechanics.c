/* The motion of a system of `model.h`: accelerations, projection onto the constraints, integration. Any consistent set of units.
   There are no variables but those of `Motion`, which is plain data. Functions return a sentence where they fail, otherwise NULL. */
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <string.h>
#include "solve.c"

#define MOST_ITERATIONS 50
#define ON_CONSTRAINTS 1e-9    /* residual, relative to the terms of its row */
#define ROUNDING 1e-14         /* the same, of a state that need not be projected */
#define DEFAULT_TOLERANCE 1e-9 /* relative */
#define SHARE 0.01             /* of its largest value so far, what a component near zero is compared with */
#define FIRST_STEP 1e-3        /* of the motion */
#define MARGIN 64              /* roundings of what weighs most, that count as noise */

typedef struct {
    double values[SIZE];
    double given[X_SIZE];   /* the state at the start, before its projection */
    double largest[X_SIZE]; /* magnitude of each component so far */
    double matrix[Z_SIZE * Z_SIZE];
    double step, duration, tolerance; /* duration: 0 if unknown */
    int is_accelerated;               /* whether accelerations belong to the state */
    int is_known;                     /* and what follows from them */
    int is_projected;                 /* whether the state follows from `given` */
    int mode;
} Motion;

/* Notes that the state, a parameter or an input has changed. */
static void forget(Motion *m)
{
    m->is_accelerated = m->is_known = 0;
}

/* A and its solution at the state. */
static const char *accelerate(Motion *m)
{
    double y[Z_SIZE * Z_SIZE + Z_SIZE + S_SIZE], work[Z_SIZE][Z_SIZE], *z = m->values + Z_AT;
    if (m->is_accelerated) return NULL;
    equations(m->values, y);
    memcpy(m->matrix, y, sizeof m->matrix);
    memcpy(work, y, sizeof work);
    solve(Z_SIZE, Q_SIZE, work, y + Z_SIZE * Z_SIZE, z);
    memcpy(m->values + R_AT, y + Z_SIZE * Z_SIZE + Z_SIZE, S_SIZE * sizeof *y);
    for (int i = Z_AT; i < D_AT; i++)
        if (!isfinite(m->values[i])) return "an acceleration, a constraint force or a rate is not finite";
    m->is_accelerated = 1;
    return NULL;
}

/* All that follows from the state. */
static const char *evaluate(Motion *m)
{
    const char *failure = accelerate(m);
    if (failure || m->is_known) return failure;
    outputs(m->values, m->values + D_AT);
    for (int i = D_AT; i < SIZE; i++)
        if (!isfinite(m->values[i])) return "an output is not finite";
    m->is_known = 1;
    return NULL;
}

/* What weighs as much as one of any other coordinate; 0 of one without inertia. */
static double unit(const Motion *m, int i)
{
    double mass = fabs(m->matrix[i * Z_SIZE + i]);
    return mass > 0 ? 1 / sqrt(mass) : 0;
}

/* The largest of n numbers, one for each coordinate, in these units. */
static double reach(const Motion *m, const double *x)
{
    double found = 0;
    for (int i = 0; i < Q_SIZE; i++)
        if (unit(m, i) > 0) found = fmax(found, fabs(x[i]) / unit(m, i));
    return found;
}

/* The residuals of g or psi, and the largest relative to the terms of its row, where coordinates that weigh the same are compared with each
   other; NaN where one is. */
static double off_constraints(Motion *m, double *residual, int of_velocities)
{
    double y[2 * G_SIZE + PSI_SIZE + 1], worst = 0;
    const double *x = m->values + (of_velocities ? V_AT : Q_AT), *own = of_velocities ? y + G_SIZE : y, all = reach(m, x);
    constraints(m->values, y);
    for (int i = 0; i < (of_velocities ? PSI_SIZE : G_SIZE); i++) {
        const double *row = m->matrix + (Q_SIZE + i) * Z_SIZE;
        double size = of_velocities ? 0 : y[G_SIZE + PSI_SIZE + i], rest = own[i];
        for (int j = 0; j < Q_SIZE; j++) size += fabs(row[j]) * fmax(fabs(x[j]), unit(m, j) * all), rest -= row[j] * x[j];
        if (of_velocities) size += fabs(rest);
        residual[i] = own[i];
        if (own[i] != 0 && !(fabs(own[i]) / size <= worst)) worst = fabs(own[i]) / size;
        if (isnan(own[i])) return NAN;
    }
    return worst;
}

/* The change that removes these residuals and leads, in the metric of M, nearest to where the state is moved by `pull`. */
static void nearest(const Motion *m, int rows, const double *pull, const double *residual, double *change)
{
    int size = Q_SIZE + rows;
    double A[Q_SIZE + PSI_SIZE][Q_SIZE + PSI_SIZE], b[Q_SIZE + PSI_SIZE], z[Q_SIZE + PSI_SIZE];
    double (*matrix)[size] = (double (*)[size])A;
    memset(A, 0, sizeof A);
    for (int i = 0; i < Q_SIZE; i++) {
        b[i] = 0;
        for (int j = 0; j < Q_SIZE; j++) matrix[i][j] = m->matrix[i * Z_SIZE + j], b[i] += matrix[i][j] * pull[j];
    }
    for (int i = 0; i < rows; i++) {
        b[Q_SIZE + i] = -residual[i];
        for (int j = 0; j < Q_SIZE; j++) {
            matrix[Q_SIZE + i][j] = m->matrix[(Q_SIZE + i) * Z_SIZE + j];
            matrix[j][Q_SIZE + i] = -matrix[Q_SIZE + i][j];
        }
    }
    solve(size, Q_SIZE, matrix, b, z);
    memcpy(change, z, Q_SIZE * sizeof *z);
}

/* A where the state has changed. */
static const char *changed(Motion *m)
{
    forget(m);
    return accelerate(m);
}

/* The position on the constraints nearest to the state, by Newton's method, then the velocity. */
static const char *project(Motion *m)
{
    static const char *const NONE = "no state on the constraints was found near the given one";
    double pull[Q_SIZE], change[Q_SIZE], residual[PSI_SIZE + 1], there[Q_SIZE], *q = m->values + Q_AT, *v = m->values + V_AT;
    double before = INFINITY;
    const char *failure = accelerate(m);
    if (failure || PSI_SIZE == 0) return failure;
    memcpy(there, q, sizeof there);
    for (int k = 0; k < MOST_ITERATIONS; k++) {
        double size = 0, largest = 0, off = off_constraints(m, residual, 0);
        if (isnan(off)) return NONE;
        if (off < ROUNDING && k == 0) break;
        for (int i = 0; i < Q_SIZE; i++) pull[i] = there[i] - q[i];
        nearest(m, G_SIZE, pull, residual, change);
        for (int i = 0; i < Q_SIZE; i++) {
            double mass = sqrt(fabs(m->matrix[i * Z_SIZE + i]));
            q[i] += change[i];
            size = fmax(size, mass * fabs(change[i])), largest = fmax(largest, mass * fabs(q[i]));
        }
        failure = changed(m);
        if (failure) return NONE;
        if (size <= DBL_EPSILON * largest || (off < ON_CONSTRAINTS && size >= before)) break;
        before = size;
    }
    if (!(off_constraints(m, residual, 0) < ON_CONSTRAINTS)) return NONE;
    memset(pull, 0, sizeof pull);
    for (int k = 0; k < 2 && !(off_constraints(m, residual, 1) < ROUNDING); k++) {
        nearest(m, PSI_SIZE, pull, residual, change);
        for (int i = 0; i < Q_SIZE; i++) v[i] += change[i];
        failure = changed(m);
        if (failure) return NONE;
    }
    return off_constraints(m, residual, 1) < ON_CONSTRAINTS ? NULL : NONE;
}

/* The largest residual of a constraint, relative to the terms of its row. */
static double drift(Motion *m)
{
    double residual[PSI_SIZE + 1];
    return PSI_SIZE == 0 ? 0 : fmax(off_constraints(m, residual, 0), off_constraints(m, residual, 1));
}

/* The state at the start: the nearest on the constraints to the given one. */
static const char *begin(Motion *m)
{
    const char *failure;
    if (m->is_projected) return evaluate(m);
    memcpy(m->values + Q_AT, m->given, sizeof m->given);
    forget(m);
    failure = project(m);
    if (failure) return failure;
    for (int i = 0; i < X_SIZE; i++) m->largest[i] = fabs(m->values[Q_AT + i]);
    m->is_projected = 1;
    return evaluate(m);
}

/* The rate of the state. */
static const char *rate(Motion *m, double *f)
{
    const char *failure = accelerate(m);
    memcpy(f, m->values + V_AT, Q_SIZE * sizeof *f);
    memcpy(f + Q_SIZE, m->values + Z_AT, Q_SIZE * sizeof *f);
    memcpy(f + 2 * Q_SIZE, m->values + R_AT, S_SIZE * sizeof *f);
    return failure;
}

/* The error of a step relative to the tolerance: each component by its own size, and by rounding of what weighs most. */
static double relative_error(const Motion *m, const double *x, const double *error, double h)
{
    const double *y = m->values + Q_AT, of_q = reach(m, m->largest), of_v = reach(m, m->largest + Q_SIZE), of_a = reach(m, m->values + Z_AT);
    double worst = 0;
    for (int i = 0; i < X_SIZE; i++) {
        double own = fmax(fabs(x[i]), fabs(y[i])), noise = i < 2 * Q_SIZE ? unit(m, i % Q_SIZE) : 0;
        noise *= i < Q_SIZE ? of_q + h * of_v : of_v + h * of_a;
        own = m->tolerance * (own + SHARE * fmax(m->largest[i], own)) + MARGIN * DBL_EPSILON * noise;
        if (isnan(error[i])) return NAN;
        if (error[i] != 0) worst = fmax(worst, fabs(error[i]) / own);
    }
    return worst;
}

/* A step of length h by the pair of Dormand and Prince, from the state x with the rate k[0]; k[6] is the rate behind it. */
static const char *dormand_prince(Motion *m, const double *x, double (*k)[X_SIZE], double h, double *error)
{
    static const double C[7] = {0, 1. / 5, 3. / 10, 4. / 5, 8. / 9, 1, 1};
    static const double A[7][6] = {
        {0},
        {1. / 5},
        {3. / 40, 9. / 40},
        {44. / 45, -56. / 15, 32. / 9},
        {19372. / 6561, -25360. / 2187, 64448. / 6561, -212. / 729},
        {9017. / 3168, -355. / 33, 46732. / 5247, 49. / 176, -5103. / 18656},
        {35. / 384, 0, 500. / 1113, 125. / 192, -2187. / 6784, 11. / 84},
    };
    static const double E[7] = {71. / 57600, 0, -71. / 16695, 71. / 1920, -17253. / 339200, 22. / 525, -1. / 40};
    const double t = m->values[0];
    for (int stage = 1; stage < 7; stage++) {
        const char *failure;
        m->values[0] = t + C[stage] * h;
        for (int i = 0; i < X_SIZE; i++) {
            double sum = 0;
            for (int j = 0; j < stage; j++) sum += A[stage][j] * k[j][i];
            m->values[Q_AT + i] = x[i] + h * sum;
        }
        forget(m);
        failure = rate(m, k[stage]);
        if (failure) return failure;
    }
    for (int i = 0; i < X_SIZE; i++) {
        error[i] = 0;
        for (int j = 0; j < 7; j++) error[i] += h * E[j] * k[j][i];
    }
    return NULL;
}

/* The motion up to a time, with inputs held. */
static const char *advance(Motion *m, double end)
{
    double x[X_SIZE], error[X_SIZE], k[7][X_SIZE];
    const char *failure = accelerate(m);
    if (!failure && drift(m) > ON_CONSTRAINTS) failure = project(m); /* a parameter has changed */
    if (!(m->step > 0)) m->step = FIRST_STEP * (m->duration > 0 ? m->duration : end - m->values[0]);
    if (failure || (failure = evaluate(m)) || (failure = rate(m, k[0]))) return failure;
    while (m->values[0] < end) {
        const double t = m->values[0], left = end - t;
        const int is_last = 1.0000001 * m->step >= left;
        const double h = is_last ? left : m->step;
        double size, factor;
        memcpy(x, m->values + Q_AT, sizeof x);
        failure = dormand_prince(m, x, k, h, error);
        size = failure ? NAN : relative_error(m, x, error, h);
        factor = size > 0 ? fmin(10, fmax(0.2, 0.9 * pow(size, -0.2))) : isnan(size) ? 0.2 : 10;
        if (!(size <= 1)) { /* back, and once more */
            m->values[0] = t;
            memcpy(m->values + Q_AT, x, sizeof x);
            forget(m);
            m->step = factor * h;
            if (m->step < 16 * DBL_EPSILON * fmax(fabs(t), fabs(end))) return failure ? failure : "steps became too short for the tolerance";
            continue;
        }
        if (!is_last || factor * h > m->step || factor < 1) m->step = factor * h;
        m->values[0] = is_last ? end : t + h;
        failure = drift(m) > ROUNDING ? project(m) : NULL;
        if (failure || (failure = rate(m, k[0]))) return failure;
        for (int i = 0; i < X_SIZE; i++) m->largest[i] = fmax(m->largest[i], fabs(m->values[Q_AT + i]));
    }
    return evaluate(m);
}

/* Derivatives of all values along dx of t, state, parameters and inputs. */
static const char *differentiate(Motion *m, double *dx)
{
    double dy[Z_SIZE * Z_SIZE + Z_SIZE + S_SIZE], work[Z_SIZE][Z_SIZE], *b = dy + Z_SIZE * Z_SIZE;
    const char *failure = evaluate(m);
    if (failure) return failure;
    equations_tangent(m->values, dx, dy);
    for (int i = 0; i < Z_SIZE; i++)
        for (int j = 0; j < Z_SIZE; j++) b[i] -= dy[i * Z_SIZE + j] * m->values[Z_AT + j];
    memcpy(work, m->matrix, sizeof work);
    if (solve(Z_SIZE, Q_SIZE, work, b, dx + Z_AT) < Z_SIZE) return "derivatives need constraints that do not depend on each other";
    memcpy(dx + R_AT, b + Z_SIZE, S_SIZE * sizeof *dx);
    outputs_tangent(m->values, dx, dx + D_AT);
    for (int i = Z_AT; i < SIZE; i++)
        if (!isfinite(dx[i])) return "a derivative is not finite";
    return NULL;
}

/* The derivative of the state at the start, in the place of that of the given one. */
static const char *differentiate_start(const Motion *m, double *dx)
{
    double pull[2 * Q_SIZE], rate[G_SIZE + PSI_SIZE + 1];
    if (PSI_SIZE == 0) return NULL;
    for (int i = 0; i < 2 * Q_SIZE; i++) { /* elsewhere it depends on how constraints bend */
        const double *x = m->values + Q_AT;
        const double size = unit(m, i % Q_SIZE) * reach(m, i < Q_SIZE ? x : x + Q_SIZE);
        if (fabs(x[i] - m->given[i]) > ON_CONSTRAINTS * fmax(fabs(x[i]), size))
            return "derivatives during initialization need a start that is on the constraints";
    }
    memcpy(pull, dx + Q_AT, sizeof pull);
    memset(dx + Q_AT, 0, sizeof pull);
    constraints_tangent(m->values, dx, rate);
    nearest(m, G_SIZE, pull, rate, dx + Q_AT);
    constraints_tangent(m->values, dx, rate);
    nearest(m, PSI_SIZE, pull + Q_SIZE, rate + G_SIZE, dx + V_AT);
    return NULL;
}
