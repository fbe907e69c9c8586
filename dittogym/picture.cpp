// The observation of all simulations in one call: the arithmetic of dittogym/observation.py in the same order.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "team.hpp"

// As in dittogym/observation.py.
constexpr int SIZE = 64, BLOCK = 8, RASTER = 1024, FRAME = 3;
constexpr int FINE = SIZE * BLOCK, WORDS = FINE / 64, WIDE = SIZE + 2 * FRAME;

// As `class Picture` in observation.py. Tensors are contiguous, of Real; where nothing else is said leading batch.
struct Picture {
    int64_t batch, particles, threads, pixels;
    Pool pool;
    int64_t bodies, boxes;
    const double* body;      // (bodies, 3): particles, full-size particles that one stands for, hidden velocity
    const double* box;       // (boxes, 5): left, right, bottom, top, closed
    double view[2];          // centre of the view in the window, m; NaN: the robot's
    double margin, extent;   // particles between these are in the window, m
    double clip, saturation;
    const void* x;           // (2, batch, particles)
    const void* v;           // (2, batch, particles)
    const void* origin;      // (batch, 2)
    const void* centre;      // (batch, 2)
    uint8_t* image;          // (batch, 3, SIZE, SIZE)
};

namespace {

template <class Real> struct Drawing {
    const Picture& picture;
    int64_t element = 0;
    Real left = 0, bottom = 0;  // the window's corner
    int row = 0, column = 0;    // the crop's corner in fine pixels
    uint8_t resting;            // code of no velocity
    std::vector<Real> px, py, vx, vy;
    std::vector<uint8_t> visible, wins;
    std::vector<int> pixel;                       // fine pixel of a particle, or -1 where it is not in the picture
    std::vector<uint64_t> covered, taken;         // by obstacles, by particles: a bit for each fine pixel
    std::vector<Real> fraction;                      // of an image pixel that obstacles cover
    std::vector<std::array<Real, 4>> sums;        // occupancy, two velocities, occupancy of what shows its velocity

    explicit Drawing(const Picture& given)
        : picture(given), px(given.particles), py(given.particles), vx(given.particles), vy(given.particles),
          visible(given.particles), covered(given.boxes ? FINE * WORDS : 0), fraction(given.boxes ? SIZE * SIZE : 0),
          sums(given.pixels ? SIZE * SIZE : WIDE * WIDE) {
        resting = velocity_code(0);
        if (!given.pixels) return;
        wins.resize(given.particles), pixel.resize(given.particles), taken.resize(FINE * WORDS);
    }

    void run(int64_t which) {
        element = which;
        place();
        read_particles();
        draw_boxes();
        std::fill(sums.begin(), sums.end(), std::array<Real, 4>{});
        picture.pixels ? draw_pixels() : splat();
    }

    static int corner(Real centre) {
        const Real fine = std::trunc(Real(RASTER) * centre);
        const int half = FINE / 2;
        if (!(fine > half)) return 0;  // also where the centre is not a number
        return fine > RASTER - half ? RASTER - FINE : int(fine) - half;
    }

    void place() {
        const Real* origin = static_cast<const Real*>(picture.origin) + 2 * element;
        const Real* centre = static_cast<const Real*>(picture.centre) + 2 * element;
        left = origin[0], bottom = origin[1];
        const auto view = [&](int axis) {
            return std::isnan(picture.view[axis]) ? centre[axis] - origin[axis] : Real(picture.view[axis]);
        };
        column = corner(view(0)), row = RASTER - corner(view(1)) - FINE;
    }

    void read_particles() {
        const int64_t count = picture.particles, plane = picture.batch * count;
        const Real* x = static_cast<const Real*>(picture.x) + element * count;
        const Real* v = static_cast<const Real*>(picture.v) + element * count;
        const Real margin = Real(picture.margin), extent = Real(picture.extent), clip = Real(picture.clip);
        int64_t first = 0;
        for (int64_t b = 0; b < picture.bodies; ++b) {
            const int64_t end = first + int64_t(picture.body[3 * b]);
            const Real moving = picture.body[3 * b + 2] != 0 ? Real(0) : Real(1);
            for (int64_t k = first; k < end; ++k) {
                px[k] = x[k] - left, py[k] = x[k + plane] - bottom;
                vx[k] = moving * std::min(std::max(Real(2) * v[k], -clip), clip);
                vy[k] = moving * std::min(std::max(Real(2) * v[k + plane], -clip), clip);
                // The difference of a number to itself is zero, that of anything else is not a number.
                const Real all = (x[k] + v[k]) + (x[k + plane] + v[k + plane]);
                visible[k] = (all - all == 0) & (px[k] > margin) & (px[k] < extent);
            }
            first = end;
        }
    }

    static bool between(Real value, const double* ends, bool closed) {
        const Real low = Real(ends[0]), high = Real(ends[1]);
        return closed ? value >= low && value <= high : value > low && value < high;
    }

    void draw_boxes() {
        if (!picture.boxes) return;
        std::fill(covered.begin(), covered.end(), uint64_t(0));
        for (int64_t b = 0; b < picture.boxes; ++b) {
            const double* box = picture.box + 5 * b;
            std::array<uint64_t, WORDS> across{};
            for (int c = 0; c < FINE; ++c)
                if (between(Real(float(column + c) / RASTER) + left, box, box[4] != 0))
                    across[c / 64] |= uint64_t(1) << (c % 64);
            for (int r = 0; r < FINE; ++r)
                if (between(Real(float(RASTER - row - r) / RASTER) + bottom, box + 2, box[4] != 0))
                    for (int w = 0; w < WORDS; ++w) covered[r * WORDS + w] |= across[w];
        }
        std::fill(fraction.begin(), fraction.end(), Real(0));
        for (int r = 0; r < FINE; ++r)
            for (int w = 0; w < WORDS; ++w) {
                const uint64_t word = covered[r * WORDS + w];
                for (int c = 0; word && c < 64 / BLOCK; ++c)  // most words are empty
                    fraction[r / BLOCK * SIZE + w * (64 / BLOCK) + c] +=
                        Real(__builtin_popcount(word >> (c * BLOCK) & ((1u << BLOCK) - 1))) / (BLOCK * BLOCK);
            }
    }

    void find_pixels() {
        const Real first_row = Real(row), first_column = Real(column);
        for (int64_t k = 0; k < picture.particles; ++k) {
            const Real r = std::trunc((Real(1) - py[k]) * Real(RASTER)) - first_row;
            const Real c = std::trunc(px[k] * Real(RASTER)) - first_column;
            const bool inside = visible[k] & (py[k] > 0) & (r >= 0) & (r < FINE) & (c >= 0) & (c < FINE);
            pixel[k] = inside ? int(inside ? r : 0) * FINE + int(inside ? c : 0) : -1;
        }
    }

    // A fine pixel belongs to the last particle in it that shows its velocity, or else to the last at all.
    void claim(bool hidden) {
        int64_t end = picture.particles;
        for (int64_t b = picture.bodies - 1; b >= 0; --b) {
            const int64_t first = end - int64_t(picture.body[3 * b]);
            if ((picture.body[3 * b + 2] != 0) == hidden)
                for (int64_t k = end - 1; k >= first; --k) {
                    if (pixel[k] < 0) continue;
                    uint64_t& word = taken[pixel[k] / 64];
                    const uint64_t bit = uint64_t(1) << (pixel[k] % 64);
                    wins[k] = !(word & bit);
                    word |= bit;
                }
            end = first;
        }
    }

    void draw_pixels() {
        std::fill(taken.begin(), taken.end(), uint64_t(0));
        std::fill(wins.begin(), wins.end(), uint8_t(0));
        find_pixels();
        claim(false), claim(true);
        for (int64_t k = 0; k < picture.particles; ++k) {
            if (!wins[k]) continue;
            const int r = pixel[k] / FINE, c = pixel[k] % FINE;
            std::array<Real, 4>& sum = sums[(r / BLOCK) * SIZE + c / BLOCK];
            if (!picture.boxes || !(covered[pixel[k] / 64] >> (pixel[k] % 64) & 1)) sum[0] += 1;
            sum[1] += vx[k], sum[2] += vy[k];
        }
        constexpr Real area = BLOCK * BLOCK;
        for (int cell = 0; cell < SIZE * SIZE; ++cell) {
            const auto& [occupied, across, up, _] = sums[cell];
            quantise(cell, occupied / area + (picture.boxes ? fraction[cell] : Real(0)), across / area, up / area);
        }
    }

    void splat() {
        constexpr Real middle = Real(0.5) * SIZE, reach = middle + Real(1.5);
        int64_t k = 0;
        for (int64_t b = 0; b < picture.bodies; ++b) {
            const Real stands_for = Real(picture.body[3 * b + 1]);
            const Real moving = picture.body[3 * b + 2] != 0 ? Real(0) : Real(1);
            for (const int64_t end = k + int64_t(picture.body[3 * b]); k < end; ++k) {
                const Real u = px[k] * Real(RASTER / BLOCK) - Real(float(column) / BLOCK) - Real(0.5);
                const Real w = (Real(1) - py[k]) * Real(RASTER / BLOCK) - Real(float(row) / BLOCK) - Real(0.5);
                if (!visible[k] || !(std::abs(u - middle) < reach && std::abs(w - middle) < reach)) continue;
                const Real base_u = std::floor(u - Real(0.5)), base_w = std::floor(w - Real(0.5));
                const std::array<Real, 3> across = weights(u - base_u), along = weights(w - base_w);
                const std::array<Real, 4> each{1, moving * vx[k], moving * vy[k], moving};
                std::array<Real, 4>* node = sums.data() + (int(base_w) + FRAME) * WIDE + int(base_u) + FRAME;
                for (int i = 0; i < 3; ++i, node += WIDE)
                    for (int j = 0; j < 3; ++j) {
                        const Real weight = along[i] * (across[j] * stands_for);
                        for (int n = 0; n < 4; ++n) node[j][n] += weight * each[n];
                    }
            }
        }
        const Real saturation = Real(picture.saturation);
        for (int r = 0; r < SIZE; ++r)
            for (int c = 0; c < SIZE; ++c) {
                const auto& [expected, across, up, expected_moving] = sums[(r + FRAME) * WIDE + c + FRAME];
                const Real free = picture.boxes ? Real(1) - fraction[r * SIZE + c] : Real(1);
                // Most pixels are empty: that spares their exponentials.
                const Real miss = expected > 0 ? std::exp(-expected / saturation) : Real(1);
                const Real hit = expected_moving > 0 ? (Real(1) - std::exp(-expected_moving / saturation)) / expected_moving : Real(0);
                quantise(r * SIZE + c, Real(1) - free * miss, across * hit, up * hit);
            }
    }

    // Weights of the three pixels around a point (`quadratic_weights` in torchmpm/spline.py).
    static std::array<Real, 3> weights(Real f) {
        const Real a = Real(1.5) - f, b = f - Real(1), c = f - Real(0.5);
        return {Real(0.5) * (a * a), Real(0.75) - b * b, Real(0.5) * (c * c)};
    }

    void quantise(int cell, Real occupancy, Real across, Real up) {
        uint8_t* image = picture.image + element * 3 * SIZE * SIZE + cell;
        image[0] = code(Real(255) * occupancy);
        const bool rests = across == 0 && up == 0;  // as in most pixels
        image[SIZE * SIZE] = rests ? resting : velocity_code(across);
        image[2 * SIZE * SIZE] = rests ? resting : velocity_code(up);
    }
    uint8_t velocity_code(Real mean) const {
        const Real clip = Real(picture.clip);
        return code(Real(10) * (Real(255) * (mean + clip) / (2 * clip) - Real(127)) + Real(127));
    }
    static uint8_t code(Real value) { return uint8_t(std::min(std::max(value, Real(0)), Real(255))); }
};

template <class Real> int draw(const Picture* picture) {
    try {
        const int threads = int(std::max<int64_t>(1, std::min(picture->threads, picture->batch)));
        std::vector<Drawing<Real>> drawings;
        drawings.reserve(threads);
        for (int rank = 0; rank < threads; ++rank) drawings.emplace_back(*picture);
        std::atomic<int64_t> next{0};
        const auto work = [&](int rank) {
            for (int64_t element; (element = next.fetch_add(1)) < picture->batch;) drawings[rank].run(element);
        };
        if (!run_together(picture->pool, threads, work)) work(0);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

}  // namespace

// 0, or 1 where memory ran out.
extern "C" int dittogym_draw_float(const Picture* picture) { return draw<float>(picture); }
extern "C" int dittogym_draw_double(const Picture* picture) { return draw<double>(picture); }
