// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireStateFile.h"

#include <array>
#include <cerrno>
#include <cstdio>
#include <cstring>
#include <random>
#include <system_error>

#if defined(_WIN32)
#include <filesystem>
#include <fstream>
#else
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>
#endif

namespace
{
// Returns an error text. `code` is a number of the category `kind`: by default, a value of errno.
std::string Because(const char* name, const char* what, int code,
  const std::error_category& kind = std::generic_category())
{
  return std::string(name) + " cannot be " + what + ": " + kind.message(code);
}

std::string TooLarge(const char* name)
{
  return std::string(name) + " is larger than " + std::to_string(vtkEntire::MAX_STATE_BYTES) +
    " bytes, the limit for a saved state; give a file that SaveState() wrote";
}

std::string NotRegular(const char* name)
{
  return std::string(name) + " is not a regular file; give a file that SaveState() wrote";
}

// An unpredictable file name in the folder of `name`.
std::string Beside(const char* name)
{
  std::random_device random;
  char text[24];
  std::snprintf(text, sizeof text, ".%08x%08x", random(), random());
  return std::string(name) + text + ".part";
}

#if defined(_WIN32)
// Path of a file name, which is UTF-8 as everywhere in VTK; empty if the name is not valid UTF-8.
std::filesystem::path Path(const std::string& name)
{
  try
  {
    return std::filesystem::u8path(name);
  }
  catch (const std::system_error&)
  {
    return {};
  }
}
#else
// Closes a file descriptor at the end of a scope.
struct Descriptor
{
  int Number;
  explicit Descriptor(int number)
    : Number(number)
  {
  }
  ~Descriptor()
  {
    if (this->Number >= 0)
    {
      ::close(this->Number);
    }
  }
  Descriptor(const Descriptor&) = delete;
  void operator=(const Descriptor&) = delete;
};

bool WriteAll(int file, const std::uint8_t* at, std::size_t left)
{
  while (left > 0)
  {
    const ssize_t done = ::write(file, at, left);
    if (done < 0 && errno == EINTR)
    {
      continue;
    }
    if (done <= 0)
    {
      return false;
    }
    at += done;
    left -= static_cast<std::size_t>(done);
  }
  return true;
}
#endif
}

namespace vtkEntire
{
#if defined(_WIN32)
//------------------------------------------------------------------------------
std::string ReadStateFile(const char* name, std::vector<std::uint8_t>& bytes)
{
  const std::filesystem::path path = Path(name);
  std::error_code code;
  const auto status = std::filesystem::status(path, code);
  if (!std::filesystem::exists(status))
  {
    return Because(name, "read", ENOENT);
  }
  if (!std::filesystem::is_regular_file(status))
  {
    return NotRegular(name);
  }
  std::ifstream file(path, std::ios::binary);
  std::vector<std::uint8_t> read(MAX_STATE_BYTES + 1);
  file.read(reinterpret_cast<char*>(read.data()), static_cast<std::streamsize>(read.size()));
  if (file.bad() || (file.fail() && !file.eof()))
  {
    return Because(name, "read", EIO);
  }
  read.resize(static_cast<std::size_t>(file.gcount()));
  if (read.size() > MAX_STATE_BYTES)
  {
    return TooLarge(name);
  }
  bytes = std::move(read);
  return {};
}

//------------------------------------------------------------------------------
std::string WriteStateFile(const char* name, const std::vector<std::uint8_t>& bytes)
{
  const std::filesystem::path aside = Path(Beside(name));
  std::ofstream file(aside, std::ios::binary | std::ios::trunc);
  file.write(reinterpret_cast<const char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  file.close();
  std::error_code code(file ? 0 : EIO, std::generic_category());
  if (!code)
  {
    // Replaces the earlier file in one step. Fails if another process has it open.
    std::filesystem::rename(aside, Path(name), code);
  }
  if (code)
  {
    std::error_code ignored;
    std::filesystem::remove(aside, ignored);
    return Because(name, "written", code.value(), code.category());
  }
  return {};
}
#else
//------------------------------------------------------------------------------
std::string ReadStateFile(const char* name, std::vector<std::uint8_t>& bytes)
{
  // Without O_NONBLOCK, open() of a pipe waits for a writer.
  const Descriptor file(::open(name, O_RDONLY | O_NONBLOCK | O_CLOEXEC));
  if (file.Number < 0)
  {
    return Because(name, "read", errno);
  }
  struct stat about;
  if (::fstat(file.Number, &about) != 0)
  {
    return Because(name, "read", errno);
  }
  if (!S_ISREG(about.st_mode))
  {
    return NotRegular(name);
  }
  // Counts the bytes that were read, since the file may grow during the reading.
  std::vector<std::uint8_t> all;
  std::array<std::uint8_t, 16384> block;
  for (;;)
  {
    const ssize_t count = ::read(file.Number, block.data(), block.size());
    if (count < 0 && errno == EINTR)
    {
      continue;
    }
    if (count < 0)
    {
      return Because(name, "read", errno);
    }
    if (count == 0)
    {
      break;
    }
    all.insert(all.end(), block.begin(), block.begin() + count);
    if (all.size() > MAX_STATE_BYTES)
    {
      return TooLarge(name);
    }
  }
  bytes = std::move(all);
  return {};
}

//------------------------------------------------------------------------------
std::string WriteStateFile(const char* name, const std::vector<std::uint8_t>& bytes)
{
  const std::string aside = Beside(name);
  int code = 0;
  {
    const Descriptor file(::open(aside.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0666));
    if (file.Number < 0)
    {
      return Because(name, "written", errno);
    }
    if (!WriteAll(file.Number, bytes.data(), bytes.size()) || ::fsync(file.Number) != 0)
    {
      code = errno ? errno : EIO;
    }
  }
  if (code == 0 && ::rename(aside.c_str(), name) != 0)
  {
    code = errno;
  }
  if (code != 0)
  {
    ::unlink(aside.c_str());
    return Because(name, "written", code);
  }
  return {};
}
#endif
}
