/* Written by describe.py from the DESIGN.toml of the board: do not edit. */
#define REFERENCE_CODE 341 /* of the reference voltage */
#define REFERENCE_CODE_EXACT 341.340f
#define DRIVE_CODE 341.340f
#define FEEDBACK_OHM 15000.0f
#define EVEN_REFERENCE_OHM 10000.0f
#define ODD_REFERENCE_OHM 15000.0f
#define EVEN_REFERENCE_APPARENT_OHM 10935.3f /* behind their common switch */
#define ODD_REFERENCE_APPARENT_OHM 16361.0f
#define DESCRIPTION \
    "{\"design\":{\"array\":{\"rows\":16,\"columns\":16,\"row_segment\":0.254,\"column_segment\":0.254,\"row_lead\":70." \
    "254,\"column_lead\":0.254},\"drive\":{\"voltage\":-1.6667},\"readout\":{\"circuit\":\"inverting-amplifier\",\"ref" \
    "erence_resistance\":15000.0,\"reference_voltage\":1.6667,\"open_loop_gain\":300000.0,\"gain_bandwidth\":100" \
    "00000.0,\"offset_voltage\":0.0005,\"bias_current\":1e-12,\"supply\":[0.03,4.97],\"column_capacitance\":3.3e-" \
    "10,\"feedback_capacitance\":4.7e-10,\"voltage_noise\":8.7e-09,\"current_noise\":3e-15,\"temperature\":300.0}" \
    ",\"adc\":{\"bits\":10,\"range\":[0.0,5.0],\"sampling_capacitance\":1.4e-11,\"switch_resistance\":10000.0,\"acqu" \
    "isition_time\":3e-06}},\"cell\":{\"rest_resistance_ohm\":10000.0,\"full_scale_kpa\":15.5,\"model\":{\"e1_kpa\":" \
    "32.0,\"e2_kpa\":60.0,\"e3_kpa\":480.0,\"eta2_kpa_s\":505.0,\"eta3_kpa_s\":48000.0,\"kind\":\"paper\",\"eu1_kpa\":2" \
    "0.0,\"eu2_kpa_per_s\":16.0,\"etau2_kpa\":80.0,\"derivative_s\":0.5}}}"
