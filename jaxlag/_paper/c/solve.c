/* z of A z = b, by elimination with complete pivoting, in units in which the inertia of each of the m coordinates and the
   largest entry of each row behind them are 1; of least norm where rows are linearly dependent. Returns the rank. */
static int solve(int n, int m, double A[n][n], double *b, double *z)
{
    int place[n], rank = 0;
    double unit[n], free[n][n];
    for (int i = 0; i < n; i++) {
        double size = i < m ? sqrt(fabs(A[i][i])) : 0;
        for (int j = 0; i >= m && j < m; j++) size = fmax(size, fabs(A[i][j] * unit[j]));
        unit[i] = size > 0 ? 1 / size : 1;
        place[i] = i;
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) A[i][j] *= unit[i] * unit[j];
        b[i] *= unit[i];
    }
    for (; rank < n; rank++) {
        int row = rank, column = rank;
        for (int i = rank; i < n; i++)
            for (int j = rank; j < n; j++)
                if (fabs(A[i][j]) > fabs(A[row][column])) row = i, column = j;
        if (fabs(A[row][column]) < 1e-12) break;
        for (int j = 0; j < n; j++) { double x = A[rank][j]; A[rank][j] = A[row][j]; A[row][j] = x; }
        for (int i = 0; i < n; i++) { double x = A[i][rank]; A[i][rank] = A[i][column]; A[i][column] = x; }
        double x = b[rank]; b[rank] = b[row]; b[row] = x;
        int k = place[rank]; place[rank] = place[column]; place[column] = k;
        for (int i = 0; i < n; i++) {
            double factor = A[i][rank] / A[rank][rank];
            if (i == rank) continue;
            for (int j = rank; j < n; j++) A[i][j] -= factor * A[rank][j];
            b[i] -= factor * b[rank];
        }
    }
    for (int i = 0; i < n; i++) z[place[i]] = i < rank ? unit[place[i]] * b[i] / A[i][i] : 0;
    for (int k = rank; k < n; k++) { /* remove the null space of A from what stands behind coordinates, by orthogonal null vectors */
        for (int i = 0; i < n; i++) free[k][place[i]] = unit[place[i]] * (i < rank ? -A[i][k] / A[i][i] : i == k);
        for (int l = rank; l <= k; l++) {
            double *target = l < k ? free[k] : z, *along = l < k ? free[l] : free[k], dot = 0, square = 0;
            for (int i = m; i < n; i++) dot += along[i] * target[i], square += along[i] * along[i];
            for (int i = m; i < n; i++) target[i] -= square > 0 ? dot / square * along[i] : 0;
        }
    }
    return rank;
}
