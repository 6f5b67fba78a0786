// SPDX-License-Identifier: Apache-2.0
#include "io/output_file.h"

#include "failure.h"
#include "support/fixtures.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>

namespace {

void put(const std::string& path, const std::string& text) {
    std::ofstream(path) << text;
}

std::string get(const std::string& path) {
    std::ifstream stream(path);
    return {std::istreambuf_iterator<char>(stream), std::istreambuf_iterator<char>()};
}

size_t filesBeside(const std::string& path) {
    const std::filesystem::directory_iterator folder(std::filesystem::path(path).parent_path());
    return static_cast<size_t>(std::distance(begin(folder), end(folder)));
}

TEST(OutputFile, AppearsOnlyWhenCommitted) {
    const std::string target = fixtures::path("committed.txt");
    const size_t before = filesBeside(target);
    {
        trk::OutputFile file(target, false);
        put(file.path(), "text");
        EXPECT_FALSE(std::filesystem::exists(target));
        file.commit();
    }
    EXPECT_EQ(get(target), "text");
    EXPECT_EQ(filesBeside(target), before + 1);
}

size_t openDescriptors() {
    const std::filesystem::directory_iterator folder("/proc/self/fd");
    return static_cast<size_t>(std::distance(begin(folder), end(folder)));
}

TEST(OutputFile, AConstructorThatThrowsLeavesNothing) {
    const std::string target = fixtures::path("taken.txt");
    const std::string link = fixtures::path("dangling.txt");
    put(target, "old");
    std::filesystem::remove(link);
    std::filesystem::create_symlink("nowhere.txt", link);
    const size_t files = filesBeside(target);
    const size_t descriptors = openDescriptors();
    EXPECT_THROW(trk::OutputFile(target, false), trk::Error);
    EXPECT_THROW(trk::OutputFile(link, true), trk::Error);
    EXPECT_THROW(trk::OutputFile("/proc/self/status", true), trk::Error);
    EXPECT_THROW(trk::OutputFile("/proc/1/none", true), trk::Error);
    EXPECT_EQ(openDescriptors(), descriptors);
    EXPECT_EQ(filesBeside(target), files);
    EXPECT_TRUE(std::filesystem::is_symlink(link));
    EXPECT_FALSE(std::filesystem::exists(fixtures::path("nowhere.txt")));
}

TEST(OutputFile, LeavesNothingWithoutCommit) {
    const std::string target = fixtures::path("dropped.txt");
    put(target, "old");
    const size_t before = filesBeside(target);
    {
        const trk::OutputFile file(target, true);
        put(file.path(), "new");
    }
    EXPECT_EQ(get(target), "old");
    EXPECT_EQ(filesBeside(target), before);
}

TEST(OutputFile, ReplacesOnlyWhenForced) {
    const std::string target = fixtures::path("kept.txt");
    put(target, "old");
    EXPECT_THROW(trk::OutputFile(target, false), trk::Error);
    trk::OutputFile file(target, true);
    put(file.path(), "new");
    file.commit();
    EXPECT_EQ(get(target), "new");
}

TEST(OutputFile, OfTwoWritersOneWins) {
    const std::string target = fixtures::path("raced.txt");
    trk::OutputFile first(target, false);
    trk::OutputFile second(target, false);
    put(first.path(), "first");
    put(second.path(), "second");
    first.commit();
    EXPECT_THROW(second.commit(), trk::Error);
    EXPECT_EQ(get(target), "first");
}

TEST(OutputFile, SaysWhyItCannotWrite) {
    try {
        const trk::OutputFile file(fixtures::path("no/such/folder.txt"), false);
        FAIL();
    } catch (const trk::Error& e) {
        EXPECT_EQ(e.status(), TRK_ERROR_IO);
        EXPECT_NE(std::string(e.what()).find("No such file or directory"), std::string::npos);
    }
}

}  // namespace
