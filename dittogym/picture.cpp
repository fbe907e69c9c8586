// The observation of all simulations in one call: the arithmetic of dittogym/observation.py in the same order.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "picture.hpp"
#include "team.hpp"

using raster::BLOCK_SIZE, raster::FINE, raster::FRAME, raster::SIZE;
constexpr int WORDS = FINE / 64, WIDE = SIZE + 2 * FRAME;

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
    raster::Crop<Real> crop{};
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
        resting = raster::Codes<Real>::velocity(0, Real(picture.clip));
        if (!given.pixels) return;
        wins.resize(given.particles), pixel.resize(given.particles), taken.resize(FINE * WORDS);
    }

    void run(int64_t which) {
        element = which;
        crop = raster::Crop<Real>::around(picture.view, start(picture.origin, 2), start(picture.centre, 2));
        read_particles();
        draw_boxes();
        std::fill(sums.begin(), sums.end(), std::array<Real, 4>{});
        picture.pixels ? draw_pixels() : splat();
    }

    // Where the numbers of the element begin in an array (batch, width).
    const Real* start(const void* array, int64_t width) const { return static_cast<const Real*>(array) + width * element; }

    void read_particles() {
        const int64_t count = picture.particles, plane = picture.batch * count;
        const Real *x = start(picture.x, count), *v = start(picture.v, count);
        const Real margin = Real(picture.margin), extent = Real(picture.extent), clip = Real(picture.clip);
        int64_t first = 0;
        for (int64_t b = 0; b < picture.bodies; ++b) {
            const int64_t end = first + int64_t(picture.body[3 * b]);
            const Real moving = picture.body[3 * b + 2] != 0 ? Real(0) : Real(1);
            for (int64_t k = first; k < end; ++k) {
                px[k] = x[k] - crop.left, py[k] = x[k + plane] - crop.bottom;
                vx[k] = moving * raster::clamped(Real(2) * v[k], -clip, clip);
                vy[k] = moving * raster::clamped(Real(2) * v[k + plane], -clip, clip);
                visible[k] = raster::is_visible(x[k], x[k + plane], v[k], v[k + plane], px[k], margin, extent);
            }
            first = end;
        }
    }

    void draw_boxes() {
        if (!picture.boxes) return;
        std::fill(covered.begin(), covered.end(), uint64_t(0));
        for (int64_t b = 0; b < picture.boxes; ++b) {
            const double* box = picture.box + 5 * b;
            std::array<uint64_t, WORDS> across{};
            for (int c = 0; c < FINE; ++c)
                if (crop.column_in(box, c))
                    across[c / 64] |= uint64_t(1) << (c % 64);
            for (int r = 0; r < FINE; ++r)
                if (crop.row_in(box, r))
                    for (int w = 0; w < WORDS; ++w) covered[r * WORDS + w] |= across[w];
        }
        std::fill(fraction.begin(), fraction.end(), Real(0));
        for (int r = 0; r < FINE; ++r)
            for (int w = 0; w < WORDS; ++w) {
                const uint64_t word = covered[r * WORDS + w];
                for (int c = 0; word && c < 64 / BLOCK_SIZE; ++c)  // most words are empty
                    fraction[r / BLOCK_SIZE * SIZE + w * (64 / BLOCK_SIZE) + c] +=
                        Real(__builtin_popcount(word >> (c * BLOCK_SIZE) & ((1u << BLOCK_SIZE) - 1))) / (BLOCK_SIZE * BLOCK_SIZE);
            }
    }

    void find_pixels() {
        for (int64_t k = 0; k < picture.particles; ++k) {
            const Real r = crop.fine_row(py[k]), c = crop.fine_column(px[k]);
            const bool inside = visible[k] & crop.inside(py[k], r, c);
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
            std::array<Real, 4>& sum = sums[(r / BLOCK_SIZE) * SIZE + c / BLOCK_SIZE];
            if (!picture.boxes || !(covered[pixel[k] / 64] >> (pixel[k] % 64) & 1)) sum[0] += 1;
            sum[1] += vx[k], sum[2] += vy[k];
        }
        for (int cell = 0; cell < SIZE * SIZE; ++cell) {
            const auto& [occupied, across, up, _] = sums[cell];
            const Real covers = picture.boxes ? fraction[cell] : Real(0);
            put(cell, raster::pixel_codes(occupied, across, up, covers, Real(picture.clip), resting));
        }
    }

    void splat() {
        int64_t k = 0;
        for (int64_t b = 0; b < picture.bodies; ++b) {
            const Real stands_for = Real(picture.body[3 * b + 1]);
            const Real moving = picture.body[3 * b + 2] != 0 ? Real(0) : Real(1);
            for (const int64_t end = k + int64_t(picture.body[3 * b]); k < end; ++k) {
                const Real u = crop.pixel_column(px[k]), w = crop.pixel_row(py[k]);
                if (!visible[k] || !crop.near(u, w)) continue;
                const Real base_u = std::floor(u - Real(0.5)), base_w = std::floor(w - Real(0.5));
                const raster::Weights<Real> across(u - base_u), along(w - base_w);
                const std::array<Real, 4> each{1, moving * vx[k], moving * vy[k], moving};
                std::array<Real, 4>* node = sums.data() + (int(base_w) + FRAME) * WIDE + int(base_u) + FRAME;
                for (int i = 0; i < 3; ++i, node += WIDE)
                    for (int j = 0; j < 3; ++j) {
                        const Real weight = along.of[i] * (across.of[j] * stands_for);
                        for (int n = 0; n < 4; ++n) node[j][n] += weight * each[n];
                    }
            }
        }
        const Real saturation = Real(picture.saturation), clip = Real(picture.clip);
        for (int r = 0; r < SIZE; ++r)
            for (int c = 0; c < SIZE; ++c) {
                const auto& [expected, across, up, expected_moving] = sums[(r + FRAME) * WIDE + c + FRAME];
                const Real free = picture.boxes ? Real(1) - fraction[r * SIZE + c] : Real(1);
                put(r * SIZE + c, raster::splat_codes(expected, across, up, expected_moving, free, saturation, clip, resting));
            }
    }

    void put(int cell, raster::Codes<Real> codes) {
        uint8_t* image = picture.image + element * 3 * SIZE * SIZE + cell;
        image[0] = codes.occupancy, image[SIZE * SIZE] = codes.across, image[2 * SIZE * SIZE] = codes.up;
    }
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
