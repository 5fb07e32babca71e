// SPDX-License-Identifier: MIT OR Apache-2.0
// Files of learned states: read up to a maximum size, written completely or not at all. Names are UTF-8.
#ifndef vtkEntireStateFile_h
#define vtkEntireStateFile_h

#include <cstdint>
#include <string>
#include <vector>

namespace vtkEntire
{
// Maximum size in bytes of a file that is read. A saved state takes a few kilobytes.
constexpr std::size_t MAX_STATE_BYTES = 1 << 20;

// Reads a regular file of at most MAX_STATE_BYTES. Returns an error text, empty on success. A directory, device or pipe
// is refused without waiting for it.
std::string ReadStateFile(const char* name, std::vector<std::uint8_t>& bytes);

// Writes a new file beside `name` and renames it: readers see the earlier file or the complete new one. Returns an
// error text, empty on success; after an error the earlier file is unchanged.
std::string WriteStateFile(const char* name, const std::vector<std::uint8_t>& bytes);
}

#endif
