// The observation on CUDA: a block of threads draws some rows of one robot's image. Sums are of whole numbers, or in a fixed
// order, so an image is the same in every run.
#include "scalar.hpp"
#ifdef __CUDACC_RTC__
typedef unsigned char uint8_t;
namespace math {
using ::exp;
using ::floor;
}  // namespace math
#endif
#include "machine.cuh"

#include "picture.hpp"

// As `class Arguments` in cuda_picture.py. Tensors are contiguous; where nothing else is said leading batch.
struct Arguments {
    int64_t batch, particles, pixels, bodies, boxes;
    const double* body;      // (bodies, 3): particles, full-size particles that one stands for, hidden velocity
    const double* box;       // (boxes, 5): left, right, bottom, top, closed
    double view[2];          // centre of the view in the window, m; NaN: the robot's
    double margin, extent;   // particles between these are in the window, m
    double clip, saturation;
    double unit, speed_unit; // what one stands for in the sums of splats, and of splats times velocities
    const Real* x;           // (2, batch, particles)
    const Real* v;           // (2, batch, particles)
    const Real* origin;      // (batch, 2)
    const Real* centre;      // (batch, 2)
    uint8_t* image;          // (batch, 3, SIZE, SIZE)
};

namespace {

using raster::BLOCK_SIZE, raster::FINE, raster::SIZE;
constexpr int ROWS = 4, BANDS = SIZE / ROWS;  // image rows of a block

// Names for tests, after those of machine.cuh.
enum : int { CLEARED = BARRIERS, DRAWN };
enum : int { ADD_SPLAT = ATOMICS, CLAIM };

struct Band {
    const Arguments& given;
    const int64_t element;
    const int first;  // image row
    const raster::Crop<Real> crop;
    int32_t* const shared;

    // Calls f(particle, body, x, y, vx, vy) for the particles of this thread that are visible, in window coordinates.
    template <class Function> INLINE void each(Function f) const {
        const int64_t plane = given.batch * given.particles;
        const Real *x = given.x + element * given.particles, *v = given.v + element * given.particles;
        const Real margin = Real(given.margin), extent = Real(given.extent);
        int64_t end = 0;
        for (int64_t b = 0; b < given.bodies; ++b) {
            const int64_t begin = end;
            end += int64_t(given.body[3 * b]);
            for (int64_t k = begin + THREAD; k < end; k += TORCHMPM_THREADS) {
                const Real px = x[k] - crop.left, py = x[k + plane] - crop.bottom, vx = v[k], vy = v[k + plane];
                if (raster::is_visible(x[k], x[k + plane], vx, vy, px, margin, extent))
                    f(int(k), given.body + 3 * b, px, py, speed(vx), speed(vy));
            }
        }
    }
    INLINE Real speed(Real v) const { return raster::clamped(Real(2) * v, -Real(given.clip), Real(given.clip)); }

    INLINE bool covered(int r, int c) const {
        for (int64_t b = 0; b < given.boxes; ++b)
            if (crop.column_in(given.box + 5 * b, c) && crop.row_in(given.box + 5 * b, r)) return true;
        return false;
    }

    // Calls f(fine row, fine column) for the fine pixels of an image pixel.
    template <class Function> static INLINE void inside(int row, int column, Function f) {
        for (int r = row * BLOCK_SIZE; r < (row + 1) * BLOCK_SIZE; ++r)
            for (int c = column * BLOCK_SIZE; c < (column + 1) * BLOCK_SIZE; ++c) f(r, c);
    }

    INLINE Real cover(int row, int column) const {
        int count = 0;
        if (given.boxes) inside(row, column, [&](int r, int c) { count += covered(r, c); });
        return Real(count) / (BLOCK_SIZE * BLOCK_SIZE);
    }

    // The sums of the band in shared memory: (4, ROWS, SIZE) whole numbers of splats, across, up, and of moving splats.
    INLINE void splat() const {
        const Real to_units = Real(1) / Real(given.unit), to_speed_units = Real(1) / Real(given.speed_unit);
        each([&](int, const double* body, Real px, Real py, Real vx, Real vy) {
            const Real u = crop.pixel_column(px), w = crop.pixel_row(py);
            if (!crop.near(u, w)) return;
            const Real base_u = math::floor(u - Real(0.5)), base_w = math::floor(w - Real(0.5));
            const raster::Weights<Real> across(u - base_u), along(w - base_w);
            const bool moves = body[2] == 0;
            for (int i = 0; i < 3; ++i) {
                const int row = int(base_w) + i - first;
                if (row < 0 || row >= ROWS) continue;
                for (int j = 0; j < 3; ++j) {
                    const int column = int(base_u) + j;
                    if (column < 0 || column >= SIZE) continue;
                    const Real weight = along.of[i] * (across.of[j] * Real(body[1]));
                    int32_t* sum = shared + row * SIZE + column;
                    put(sum, weight * to_units);
                    if (!moves) continue;
                    put(sum + ROWS * SIZE, weight * vx * to_speed_units);
                    put(sum + 2 * ROWS * SIZE, weight * vy * to_speed_units);
                    put(sum + 3 * ROWS * SIZE, weight * to_units);
                }
            }
        });
    }
    static INLINE void put(int32_t* sum, Real value) {
        int32_t whole;
        round_to(value, whole);
        add<Atomic(ADD_SPLAT)>(sum, whole);
    }

    INLINE raster::Codes<Real> splat_codes(int row, int column, uint8_t resting) const {
        const Real unit = Real(given.unit), speed_unit = Real(given.speed_unit);
        const int32_t* sum = shared + (row - first) * SIZE + column;
        const auto of = [&](int k, Real one) { return Real(sum[k * ROWS * SIZE]) * one; };
        return raster::splat_codes(of(0, unit), of(1, speed_unit), of(2, speed_unit), of(3, unit), Real(1) - cover(row, column),
                                   Real(given.saturation), Real(given.clip), resting);
    }

    // For each fine pixel of the band in shared memory, 0 or 1 + the rank of the last particle in it. Particles whose
    // velocity is hidden come before all others.
    INLINE void claim() const {
        each([&](int k, const double* body, Real px, Real py, Real, Real) {
            const Real r = crop.fine_row(py), c = crop.fine_column(px);
            if (!crop.inside(py, r, c)) return;
            const int row = int(r) - first * BLOCK_SIZE;
            if (row < 0 || row >= ROWS * BLOCK_SIZE) return;
            raise<Atomic(CLAIM)>(shared + row * FINE + int(c), 1 + k + (body[2] != 0 ? 0 : int(given.particles)));
        });
    }

    INLINE raster::Codes<Real> pixel_codes(int row, int column, uint8_t resting) const {
        const int64_t plane = given.batch * given.particles;
        const Real* v = given.v + element * given.particles;
        int occupied = 0;
        Real across = 0, up = 0;
        inside(row, column, [&](int r, int c) {
            int last = shared[(r - first * BLOCK_SIZE) * FINE + c] - 1;
            if (last < 0) return;
            occupied += !covered(r, c);
            if (last < given.particles) return;  // hidden
            last -= int(given.particles);
            across += speed(v[last]), up += speed(v[last + plane]);
        });
        return raster::pixel_codes(Real(occupied), across, up, cover(row, column), Real(given.clip), resting);
    }
};

}  // namespace

KERNEL(1) void dittogym_draw(const GRID_CONSTANT Arguments given) {
    const int64_t element = BLOCK / BANDS;
    const Band band{given, element, BLOCK % BANDS * ROWS,
                    raster::Crop<Real>::around(given.view, given.origin + 2 * element, given.centre + 2 * element),
                    reinterpret_cast<int32_t*>(shared_memory())};
    const int size = given.pixels ? ROWS * BLOCK_SIZE * FINE : 4 * ROWS * SIZE;
    for (int k = THREAD; k < size; k += TORCHMPM_THREADS) band.shared[k] = 0;
    BARRIER(CLEARED);
    given.pixels ? band.claim() : band.splat();
    BARRIER(DRAWN);
    const uint8_t resting = raster::Codes<Real>::velocity(0, Real(given.clip));
    uint8_t* image = given.image + element * 3 * SIZE * SIZE;
    for (int k = THREAD; k < ROWS * SIZE; k += TORCHMPM_THREADS) {
        const int row = band.first + k / SIZE, column = k % SIZE;
        const raster::Codes<Real> codes = given.pixels ? band.pixel_codes(row, column, resting) : band.splat_codes(row, column, resting);
        uint8_t* pixel = image + row * SIZE + column;
        pixel[0] = codes.occupancy, pixel[SIZE * SIZE] = codes.across, pixel[2 * SIZE * SIZE] = codes.up;
    }
}
