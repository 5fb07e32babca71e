// SPDX-License-Identifier: MIT OR Apache-2.0
// Files of what was learned: read with a bound on their size, written whole or not at all.
#ifndef vtkEntireStateFile_h
#define vtkEntireStateFile_h

#include <cstdint>
#include <string>
#include <vector>

namespace vtkEntire
{
// The largest file that is read, in bytes. A saved state takes a few kilobytes.
constexpr std::size_t MAX_STATE_BYTES = 1 << 20;

// Reads a regular file of at most MAX_STATE_BYTES. Returns the error, or an empty text. A directory, device or pipe is
// refused without waiting for it.
std::string ReadStateFile(const char* name, std::vector<std::uint8_t>& bytes);

// Writes a new file beside `name` and renames it: readers see the earlier file or all of this one. Returns the error,
// or an empty text; the earlier file is unchanged then.
std::string WriteStateFile(const char* name, const std::vector<std::uint8_t>& bytes);
}

#endif
