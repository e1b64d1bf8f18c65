// The filters of benchmarks/program.py as one writes them in C++ with Eigen: matrices of fixed size,
// no allocation, square-root form by one Householder QR each for prediction and update. A complete
// step: gaps (a measurement that is not finite is missing), a step that would leave something that
// is not finite is not taken, a code and the NIS.
//
//     g++ -std=gnu++17 -O3 -march=native -DNDEBUG -I/usr/include/eigen3 -shared -fPIC filters.cc
#include <Eigen/Dense>
#include <cmath>

namespace {

constexpr int N = 9, M = 3;
constexpr double PROCESS = 0.1, NOISE = 1.0;  // standard deviations
constexpr double GAMMA = 50.0;  // of the H-infinity filter, which bounds the error of all states
// Points at the mean and +-REACH columns of the factor: alpha = 1, beta = 2, kappa = 0.
constexpr double REACH = 3.0, W = 1.0 / (2.0 * REACH * REACH);

enum Code { DONE = 0, MISSING = 1, PARTLY_MISSING = 2, NOT_FINITE = 5, NOT_PREDICTED = 8 };

using State = Eigen::Matrix<double, N, 1>;
using Factor = Eigen::Matrix<double, N, N>;
using Reading = Eigen::Matrix<double, M, 1>;
using Look = Eigen::Matrix<double, M, N>;

struct Model {
    Factor A;
    Look H;
    State moved(const State &x) const { return A * x + 0.01 * x.array().sin().matrix(); }
};

struct Belief {
    State mean;
    Factor factor;
    bool current;
    bool finite() const { return mean.allFinite() && factor.allFinite(); }
};

// Lower-triangular L, diagonal not negative, with L L' = tall' tall.
template <int Rows, int Columns>
Eigen::Matrix<double, Columns, Columns> triangle(const Eigen::Matrix<double, Rows, Columns> &tall)
{
    const Eigen::HouseholderQR<Eigen::Matrix<double, Rows, Columns>> qr(tall);
    Eigen::Matrix<double, Columns, Columns> lower = Eigen::Matrix<double, Columns, Columns>::Zero();
    for (int i = 0; i < Columns; ++i) {
        const double sign = qr.matrixQR()(i, i) < 0.0 ? -1.0 : 1.0;
        lower.col(i).tail(Columns - i) = sign * qr.matrixQR().row(i).tail(Columns - i).transpose();
    }
    return lower;
}

// What a linearisation makes of a function: its mean, spread and what is left over, transposed.
template <int Size, int Excess>
struct Seen {
    Eigen::Matrix<double, Size, 1> mean;
    Eigen::Matrix<double, N, Size> spread;
    Eigen::Matrix<double, Excess, Size> excess;
};

struct Taylor {
    static Seen<N, 0> transition(const Model &model, const Belief &b)
    {
        Factor F = model.A;
        F.diagonal().array() += 0.01 * b.mean.array().cos();
        return {model.moved(b.mean), (F * b.factor).transpose(), {}};
    }
    static Seen<M, 0> observation(const Model &model, const Belief &b)
    {
        return {model.H * b.mean, (model.H * b.factor).transpose(), {}};
    }
};

struct Unscented {
    template <int Size, typename Function>
    static Seen<Size, N + 1> regress(const Belief &b, Function function)
    {
        Seen<Size, N + 1> seen;
        const Eigen::Matrix<double, Size, 1> centre = function(b.mean);
        Eigen::Matrix<double, Size, 1> sum = Eigen::Matrix<double, Size, 1>::Zero();
        for (int i = 0; i < N; ++i) {
            const State offset = REACH * b.factor.col(i);
            const Eigen::Matrix<double, Size, 1> plus = function(b.mean + offset) - centre;
            const Eigen::Matrix<double, Size, 1> minus = function(b.mean - offset) - centre;
            const Eigen::Matrix<double, Size, 1> even = 0.5 * (plus + minus);
            seen.spread.row(i) = (plus - minus).transpose() / (2.0 * REACH);
            seen.excess.row(i) = std::sqrt(2.0 * W) * even.transpose();
            sum += even;
        }
        const Eigen::Matrix<double, Size, 1> shift = 2.0 * W * sum;
        seen.excess.row(N) = shift.transpose();  // times sqrt(beta - alpha^2) = 1
        seen.mean = centre + shift;
        return seen;
    }
    static Seen<N, N + 1> transition(const Model &model, const Belief &b)
    {
        return regress<N>(b, [&](const State &x) { return model.moved(x); });
    }
    static Seen<M, N + 1> observation(const Model &model, const Belief &b)
    {
        return regress<M>(b, [&](const State &x) -> Reading { return model.H * x; });
    }
};

// S (I - S'S / gamma^2)^-1 S', as S N^-T with N upper triangular, N N' that matrix: its Cholesky
// factor with rows and columns in reverse. False where there is none.
bool inflate(Factor &S)
{
    const Factor left = Factor::Identity() - S.transpose() * S / (GAMMA * GAMMA);
    const Eigen::LLT<Factor> llt(left.reverse().eval());
    if (llt.info() != Eigen::Success) { return false; }
    const Factor turned = S.transpose().colwise().reverse();
    const Factor divided = llt.matrixL().solve(turned);
    S = divided.colwise().reverse().transpose();
    return true;
}

template <int Excess>
void predict(const Seen<N, Excess> &moved, Belief &b)
{
    Eigen::Matrix<double, N + Excess + N, N> tall;
    tall.template topRows<N>() = moved.spread;
    tall.template middleRows<Excess>(N) = moved.excess;
    tall.template bottomRows<N>() = PROCESS * Factor::Identity();
    const Belief next = {moved.mean, triangle(tall), true};
    if (next.finite()) {
        b = next;
    } else {
        b.current = false;
    }
}

template <int Excess>
void update(const Seen<M, Excess> &seen, const Reading &y, Belief &b, double &nis, int &code)
{
    Eigen::Matrix<double, N + Excess + M, M + N> tall;
    tall.setZero();
    tall.template topLeftCorner<N, M>() = seen.spread;
    tall.template topRightCorner<N, N>() = b.factor.transpose();
    tall.template block<Excess, M>(N, 0) = seen.excess;
    Reading residual = y - seen.mean;
    int used = 0;
    for (int i = 0; i < M; ++i) {
        const bool present = std::isfinite(y(i));
        used += present;
        tall(N + Excess + i, i) = present ? NOISE : 1.0;
        if (!present) {
            residual(i) = 0.0;
            tall.col(i).template head<N + Excess>().setZero();
        }
    }
    nis = 0.0;
    code = MISSING;
    if (used == 0) { return; }
    code = NOT_PREDICTED;
    if (!b.current) { return; }
    const Eigen::Matrix<double, M + N, M + N> L = triangle(tall);
    const Reading white =
        L.template topLeftCorner<M, M>().template triangularView<Eigen::Lower>().solve(residual);
    const Belief next = {b.mean + L.template bottomLeftCorner<N, M>() * white,
                         L.template bottomRightCorner<N, N>(), true};
    const double sum = white.squaredNorm();
    code = NOT_FINITE;
    if (!next.finite() || !std::isfinite(sum)) { return; }
    b = next;
    nis = sum;
    code = used == M ? DONE : PARTLY_MISSING;
}

template <typename Way, bool Bounded = false>
void run(int steps, const double *A, const double *H, const double *rows, double *mean,
         double *factor, double *nis, int *code)
{
    using RowMajor = Eigen::Matrix<double, N, N, Eigen::RowMajor>;
    const Model model = {Eigen::Map<const RowMajor>(A),
                         Eigen::Map<const Eigen::Matrix<double, M, N, Eigen::RowMajor>>(H)};
    Belief b = {Eigen::Map<State>(mean), Eigen::Map<RowMajor>(factor), true};
    bool feasible = true, measured = false;
    for (int s = 0; s < steps; ++s) {
        Belief from = b;
        if (Bounded && measured) { feasible = inflate(from.factor); }
        if (feasible) {
            measured = false;
            predict(Way::transition(model, from), b);
        } else {
            b.current = false;
        }
        const Reading y = Eigen::Map<const Reading>(rows + s * M);
        update(Way::observation(model, b), y, b, nis[s], code[s]);
        measured |= code[s] == DONE || code[s] == PARTLY_MISSING;
    }
    Eigen::Map<State>(mean, N) = b.mean;
    Eigen::Map<RowMajor>(factor, N, N) = b.factor;
}

}  // namespace

// From mean (9) and factor (9, 9) over rows (steps, 3); NIS and codes of all steps. Row-major.
extern "C" void run_ekf(int steps, const double *A, const double *H, const double *rows,
                        double *mean, double *factor, double *nis, int *code)
{
    run<Taylor>(steps, A, H, rows, mean, factor, nis, code);
}

extern "C" void run_ukf(int steps, const double *A, const double *H, const double *rows,
                        double *mean, double *factor, double *nis, int *code)
{
    run<Unscented>(steps, A, H, rows, mean, factor, nis, code);
}

extern "C" void run_hinf(int steps, const double *A, const double *H, const double *rows,
                         double *mean, double *factor, double *nis, int *code)
{
    run<Taylor, true>(steps, A, H, rows, mean, factor, nis, code);
}
