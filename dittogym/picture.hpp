// What an observation is made of, as in dittogym/observation.py and in the same order: for the CPU (picture.cpp), and for CUDA
// (picture.cu), where scalar.hpp has been included before.
#pragma once
#ifndef INLINE
#include <cmath>
#include <cstdint>
#define INLINE inline __attribute__((always_inline))
namespace math = std;
#endif

namespace raster {

// As in dittogym/observation.py.
constexpr int SIZE = 64, BLOCK_SIZE = 8, RASTER = 1024, FRAME = 3;
constexpr int FINE = SIZE * BLOCK_SIZE;

template <class Real> INLINE Real clamped(Real value, Real low, Real high) {
    value = value < low ? low : value;
    return high < value ? high : value;
}

// The window's lower left corner, and the crop's corner in fine pixels.
template <class Real> struct Crop {
    Real left, bottom;
    int row, column;

    static INLINE int corner(Real centre) {
        const Real fine = math::trunc(Real(RASTER) * centre);
        const int half = FINE / 2;
        if (!(fine > half)) return 0;  // also where the centre is not a number
        return fine > RASTER - half ? RASTER - FINE : int(fine) - half;
    }

    // The view's centre in the window, m; NaN stands for that of the robot.
    static INLINE Crop around(const double* view, const Real* origin, const Real* centre) {
        const auto along = [&](int axis) { return view[axis] != view[axis] ? centre[axis] - origin[axis] : Real(view[axis]); };
        return {origin[0], origin[1], RASTER - corner(along(1)) - FINE, corner(along(0))};
    }

    // Whether a fine pixel's left edge lies in a box (left, right, bottom, top, closed), and whether its upper edge does.
    INLINE bool column_in(const double* box, int c) const { return within(Real(float(column + c) / RASTER) + left, box, box[4] != 0); }
    INLINE bool row_in(const double* box, int r) const {
        return within(Real(float(RASTER - row - r) / RASTER) + bottom, box + 2, box[4] != 0);
    }
    static INLINE bool within(Real value, const double* ends, bool closed) {
        const Real low = Real(ends[0]), high = Real(ends[1]);
        return closed ? value >= low && value <= high : value > low && value < high;
    }

    // The fine row and column in which a particle at (x, y) in the window lies; not whole numbers where it is not finite.
    INLINE Real fine_row(Real y) const { return math::trunc((Real(1) - y) * Real(RASTER)) - Real(row); }
    INLINE Real fine_column(Real x) const { return math::trunc(x * Real(RASTER)) - Real(column); }
    static INLINE bool inside(Real y, Real r, Real c) { return (y > 0) & (r >= 0) & (r < FINE) & (c >= 0) & (c < FINE); }

    // Where it lies in image pixels, and whether its splat reaches into the image.
    INLINE Real pixel_column(Real x) const { return x * Real(RASTER / BLOCK_SIZE) - Real(float(column) / BLOCK_SIZE) - Real(0.5); }
    INLINE Real pixel_row(Real y) const { return (Real(1) - y) * Real(RASTER / BLOCK_SIZE) - Real(float(row) / BLOCK_SIZE) - Real(0.5); }
    static INLINE bool near(Real u, Real w) {
        constexpr Real middle = Real(0.5) * SIZE, reach = middle + Real(1.5);
        return math::fabs(u - middle) < reach && math::fabs(w - middle) < reach;
    }
};

// Whether a particle, at px from the left end of the window, is drawn. The difference of a number to itself is zero, that of
// anything else is not a number.
template <class Real> INLINE bool is_visible(Real x, Real y, Real vx, Real vy, Real px, Real margin, Real extent) {
    const Real all = (x + vx) + (y + vy);
    return (all - all == 0) & (px > margin) & (px < extent);
}

// Weights of the three pixels around a point (`quadratic_weights` in torchmpm/transfer.py).
template <class Real> struct Weights {
    Real of[3];
    explicit INLINE Weights(Real f) {
        const Real a = Real(1.5) - f, b = f - Real(1), c = f - Real(0.5);
        of[0] = Real(0.5) * (a * a), of[1] = Real(0.75) - b * b, of[2] = Real(0.5) * (c * c);
    }
};

// Codes of an image pixel from means over its fine pixels.
template <class Real> struct Codes {
    uint8_t occupancy, across, up;

    static INLINE uint8_t code(Real value) { return uint8_t(clamped(value, Real(0), Real(255))); }
    static INLINE uint8_t velocity(Real mean, Real clip) {
        return code(Real(10) * (Real(255) * (mean + clip) / (2 * clip) - Real(127)) + Real(127));
    }
    static INLINE Codes of(Real occupancy, Real across, Real up, Real clip, uint8_t resting) {
        const bool rests = across == 0 && up == 0;  // as in most pixels
        return {code(Real(255) * occupancy), rests ? resting : velocity(across, clip), rests ? resting : velocity(up, clip)};
    }
};

// From the number of full-size particles to expect in a pixel, of those that show their velocity, their velocities, and the
// fraction of the pixel that is free of obstacles. Most pixels are empty: that spares their exponentials.
template <class Real>
INLINE Codes<Real> splat_codes(Real expected, Real across, Real up, Real moving, Real free, Real saturation, Real clip, uint8_t resting) {
    const Real miss = expected > 0 ? math::exp(-expected / saturation) : Real(1);
    const Real hit = moving > 0 ? (Real(1) - math::exp(-moving / saturation)) / moving : Real(0);
    return Codes<Real>::of(Real(1) - free * miss, across * hit, up * hit, clip, resting);
}

// From the number of fine pixels that are set, and the sums of their velocities.
template <class Real> INLINE Codes<Real> pixel_codes(Real occupied, Real across, Real up, Real covered, Real clip, uint8_t resting) {
    constexpr Real area = BLOCK_SIZE * BLOCK_SIZE;
    return Codes<Real>::of(occupied / area + covered, across / area, up / area, clip, resting);
}

}  // namespace raster
